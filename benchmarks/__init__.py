"""Speed: our own, and side by side with peers in one run. Every claim of docs/results/speed.md is printed here."""
