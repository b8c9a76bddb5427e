"""Estimation of a target by several vehicles: filters, trilateration, fusion, consistency (chapter 6)."""
