"""Feedback laws without prediction: SDRE, LQR, feedback linearization."""
