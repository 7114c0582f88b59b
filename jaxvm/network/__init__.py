"""Networks of cameras: the state, the tables of observations, and the one residual function."""
