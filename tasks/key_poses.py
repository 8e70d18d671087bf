"""Key poses of the embedded kick: plant, backswing, strike, follow-through, recovery.

Authored by hand, then refined in the truth by a cross-entropy search over these numbers. Angles are components of
joint rotation vectors [rad]: axis 0 rolls about x, 1 pitches about y, 2 yaws about z.
"""

KEY_TIMES = (0.0, 0.134, 0.267, 0.363, 0.477, 0.763, 1.145)
# Lean of the pelvis about x and y [rad], velocity of the whole body [m/s], spot of the ball on the ground [m].
START: dict[str, tuple[float, ...]] = {
    "lean": (0.0161, -0.0920),
    "velocity": (1.3248, 0.0, 0.0),
    "ball": (0.6115, -0.0978),
}
KEY_POSES = {
    ("right_thigh", 0): (-0.148, 0.103, -0.044, -0.159, 0.133, 0.006, -0.051),
    ("right_thigh", 1): (0.374, 0.693, -0.192, -1.062, -0.848, -0.650, -0.441),
    ("right_thigh", 2): (0.147, 0.091, 0.154, -0.124, -0.081, -0.035, -0.101),
    ("right_shin", 1): (0.798, 1.030, 1.393, 1.293, -0.100, 0.087, 0.459),
    ("right_foot", 1): (0.349, 0.188, 0.532, 0.757, 0.487, -0.166, 0.302),
    ("left_thigh", 0): (-0.122, -0.002, 0.039, 0.005, -0.034, 0.043, 0.125),
    ("left_thigh", 1): (-0.466, -0.092, -0.034, -0.047, -0.013, 0.372, 0.367),
    ("left_shin", 1): (0.432, 0.444, 0.428, 0.295, 0.049, 0.501, 0.556),
    ("left_foot", 1): (0.337, -0.092, -0.324, -0.062, 0.252, 0.005, 0.190),
    ("left_foot", 0): (0.059, -0.058, -0.015, 0.025, -0.109, 0.049, -0.072),
    ("torso", 0): (-0.028, -0.028, 0.016, 0.026, 0.039, 0.059, -0.004),
    ("torso", 1): (-0.085, -0.176, -0.167, 0.322, 0.320, 0.186, 0.182),
    ("torso", 2): (0.082, 0.087, -0.292, 0.119, 0.191, -0.176, -0.032),
    ("left_upper_arm", 1): (-0.301, -0.404, -0.135, 0.422, 0.403, 0.293, -0.133),
    ("left_upper_arm", 0): (0.476, 0.918, 0.814, 0.913, 0.771, 0.553, 0.332),
    ("right_upper_arm", 1): (0.046, 0.538, 0.372, -0.251, -0.323, -0.077, 0.082),
    ("right_upper_arm", 0): (-0.266, -0.449, -0.511, -0.627, -0.547, -0.461, -0.112),
    ("left_lower_arm", 1): (-0.351, -0.322, -0.233, -0.482, -0.416, -0.436, -0.318),
    ("right_lower_arm", 1): (-0.643, -0.635, -0.663, -0.779, -0.597, -0.641, -0.521),
}
