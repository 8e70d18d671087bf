"""Ground truth: classical engines behind the same description of a scene."""
