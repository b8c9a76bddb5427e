"""The OCP-QP as data: builders, condensing, validation."""

import numpy as np
import pytest
from ocp_problems import hover_qp, random_qp, tilt_rows, velocity_rows

from controllers.qp import StructuredSolver, residuals
from controllers.qp.ocp import concatenate_rows, condense, first_move_bounds, no_rows, output_rows, validate


def cost(qp, u):
    """The cost of section 1, summed stage by stage."""
    total, x = 0.0, qp.x_0
    for i, u_i in enumerate(u):
        e = x - qp.r[i]
        Q, R = (weight[i if len(weight) > 1 else 0] for weight in (qp.Q, qp.R))
        total += 0.5 * (e @ Q @ e + u_i @ R @ u_i)
        j = i if len(qp.A) > 1 else 0
        x = qp.A[j] @ x + qp.B[j] @ u_i + qp.c[i]
    e = x - qp.r[-1]
    return total + 0.5 * e @ qp.Q_f @ e


@pytest.mark.parametrize("model", ["lti", "ltv"])
def test_condensed_cost_differs_from_the_stagewise_cost_by_a_constant(model):
    rng = np.random.default_rng(0)
    qp = random_qp(rng, 6, model, "none")
    H, g, _, _ = condense(qp)
    constants = []
    for _ in range(3):
        u = rng.normal(size=(6, 4))
        flat = u.ravel()
        constants.append(cost(qp, u) - 0.5 * flat @ H @ flat - g @ flat)
    np.testing.assert_allclose(constants, constants[0], rtol=1e-10)


def test_output_rows_hold_at_every_stage_once():
    rows = tilt_rows(3, 0.3, 10.0)
    np.testing.assert_array_equal(rows.stage, [1, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(rows.normal, [0, 1, 0, 1, 0, 1])
    np.testing.assert_array_equal(rows.upper, np.full(6, 0.3))
    np.testing.assert_array_equal(rows.weight, np.full(6, 10.0))


def test_concatenated_rows_keep_their_normals():
    parts = tilt_rows(2, 0.3, 10.0), no_rows(), velocity_rows(2, 1.0, np.inf)
    rows = concatenate_rows(*parts)
    np.testing.assert_array_equal(
        rows.normals[rows.normal], np.vstack([part.normals[part.normal] for part in parts])
    )
    validate(hover_qp(2, np.zeros(12), rows=rows))


def test_concatenating_nothing_gives_no_rows():
    assert len(concatenate_rows().normal) == 0


def test_the_first_move_reaches_a_box_that_moved_away():
    qp = hover_qp(1, np.zeros(12), upper=0.0, rate_step=0.25)._replace(u_last=np.full(4, 2.0))
    lower, upper = first_move_bounds(qp)
    np.testing.assert_array_equal(lower, 0.0)
    np.testing.assert_array_equal(upper, 2.25)


def test_residuals_see_each_kind_of_error():
    qp = hover_qp(5, np.r_[3.0, 3.0, 3.0, np.zeros(9)], 0.49, 0.25, velocity_rows(5, 0.05, 5.0))
    solution = StructuredSolver().solve(qp)
    assert max(residuals(qp, solution)) < 1e-10
    assert residuals(qp, solution._replace(u=solution.u + 0.01)).stationarity > 1e-4
    assert residuals(qp, solution._replace(u=solution.u + 0.01)).primal > 1e-3
    assert residuals(qp, solution._replace(x=solution.x + 0.01)).primal > 1e-3
    raised = solution.multipliers._replace(row_upper=solution.multipliers.row_upper + 6.0)
    assert residuals(qp, solution._replace(multipliers=raised)).multiplier_bounds > 1e-3
    slack = solution.multipliers._replace(box_lower=solution.multipliers.box_lower + 0.1)
    assert residuals(qp, solution._replace(multipliers=slack)).complementarity > 1e-3


ROWS = tilt_rows(4, 0.3, 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": np.zeros((2, 12, 12))}, "A must have shape"),
        ({"x_0": np.full(12, np.nan)}, r"x_0 must be finite, got nan at \(0,\)"),
        ({"r": np.zeros((4, 12))}, "r must have shape"),
        ({"c": np.zeros((4, 24))[:, ::2]}, "c must be C-contiguous"),
        ({"c": np.zeros((4, 12), dtype=np.float32)}, "c must be a float64 array, got float32"),
        ({"lower": np.full(4, 9.0)}, "input box needs lower <= upper"),
        ({"R": np.zeros((1, 4, 4))}, "R must be positive definite"),
        ({"R": np.eye(4)}, "R must have shape"),
        ({"R": np.repeat(np.eye(4)[None], 4, axis=0)}, "one Q and one R, got 1 pairs, 1 Q and 4 R"),
        (
            {"R": np.repeat(np.eye(4)[None], 4, axis=0), "R_rate": np.eye(4), "stationary": False},
            "R_rate and R of each stage need A, B and Q of each stage",
        ),
        ({"Q": np.triu(np.ones((12, 12)))[None]}, "Q must be symmetric"),
        ({"rate_step": -1.0}, "rate_step must be >= 0"),
        ({"Q": np.repeat(np.eye(12)[None], 4, axis=0)}, "stationary needs one pair"),
        ({"rows": ROWS._replace(stage=ROWS.stage + 1)}, r"rows.stage must lie in 1..4"),
        ({"rows": ROWS._replace(normal=ROWS.normal + 1)}, r"rows.normal must lie in 0..1"),
        ({"rows": ROWS._replace(lower=ROWS.upper + 1.0)}, "state row needs lower <= upper"),
        ({"rows": ROWS._replace(weight=-ROWS.weight)}, "rows.weight must be >= 0"),
        ({"rows": ROWS._replace(normals=np.zeros((99, 12)))}, "99 normals for 8 rows"),
    ],
)
def test_validation_names_what_is_wrong(change, message):
    qp = hover_qp(4, np.zeros(12))._replace(**change)
    with pytest.raises(ValueError, match=message):
        validate(qp)


def test_output_rows_refuse_limits_of_another_length():
    with pytest.raises(ValueError, match="lower must have one entry per row of normals"):
        output_rows(np.eye(12)[:2], np.zeros(3), np.ones(2), 1.0, 4)
