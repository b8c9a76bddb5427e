"""Model predictive control of one vehicle: linear, state-dependent and exact."""
