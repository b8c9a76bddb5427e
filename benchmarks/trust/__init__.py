"""What was tried to break the project, and how often it broke: `python -m benchmarks.trust`."""
