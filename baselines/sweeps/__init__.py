"""Many of them: suites of environments and policies, flown in parallel to a results folder."""
