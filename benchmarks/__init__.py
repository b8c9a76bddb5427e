"""Speed: our own, and beside peers in one run. Every claim of docs/results/speed.md is printed here."""
