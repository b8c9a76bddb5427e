"""Several vehicles at once: formation, target tracking, cooperative estimation."""
