"""Errors of the baselines."""

from __future__ import annotations


class PolicyCheckError(ValueError):
    """A policy does not keep the protocol; the message says where."""


class PolicyError(ValueError):
    """A policy from outside cannot be made, or broke off; the message names it and the line of its file."""


class ResultsError(ValueError):
    """A results folder cannot be used; the message says why and what to do."""


class CheckpointError(ValueError):
    """A checkpoint cannot be read or written; the message says why and what to do."""


class MissingPackageError(ModuleNotFoundError):
    """A package of an extra is not installed; the message names the extra."""


class TrainingError(RuntimeError):
    """Training cannot go on; the message says at which update and why."""
