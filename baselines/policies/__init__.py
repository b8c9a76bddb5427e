"""Observation in, action out: the protocol, controllers and networks as policies, others from outside."""
