"""Speed: our own, and side by side with peers in one run. Every claim of the README is printed here."""
