"""The planner: optimises joint targets through any `Dynamics`; knows states, controls and costs only."""

from mpc.cem import CEM
from mpc.cost import CostTerm, absolute, evaluate, l2, nearest_on_path, quadratic
from mpc.dynamics import Continued, Dynamics, MujocoDynamics
from mpc.fallback import Fallback
from mpc.feedback import Feedback
from mpc.gauss_newton import GaussNewton
from mpc.gradient import Gradient
from mpc.mppi import MPPI
from mpc.planner import Plan, PlanInfo, Planner, Window
from mpc.search import Optimizer
from mpc.spline import interpolate, shift
from mpc.verified import Verified

__all__ = [
    "CEM",
    "MPPI",
    "Continued",
    "CostTerm",
    "Dynamics",
    "Fallback",
    "Feedback",
    "GaussNewton",
    "Gradient",
    "MujocoDynamics",
    "Optimizer",
    "Plan",
    "PlanInfo",
    "Planner",
    "Verified",
    "Window",
    "absolute",
    "evaluate",
    "interpolate",
    "l2",
    "nearest_on_path",
    "quadratic",
    "shift",
]
