"""Solvers on the one residual: adjustment, covariance, data snooping, robust losses."""
