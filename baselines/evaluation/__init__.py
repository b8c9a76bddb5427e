"""How good was it? Flights of a policy, and the numbers by which policies are compared."""
