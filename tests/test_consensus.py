"""References from messages: against a numpy twin, and what each option promises."""

from __future__ import annotations

import numpy as np
import pytest

from controllers.team.consensus import ConsensusOptions, TargetEstimate, consensus_reference
from quad_envs.rotations import rotation_body_from_inertial

DT, G = 0.05, 9.8
FREE = {"reach": np.inf, "speed": np.inf}
VARIANTS = {
    "default": {},
    "ungoverned": FREE,
    "frozen": {"neighbour": "frozen", "feed_forward": False, **FREE},
    "frozen-advanced": {"neighbour": "frozen", **FREE},
    "no-feed-forward": {"feed_forward": False, **FREE},
    "ca": {"neighbour": "ca", **FREE},
    "ca-attitude": {"neighbour": "ca", "attitude": True, **FREE},
    "plan": {"neighbour": "plan", **FREE},
}


def some_plants(rng, n):
    plants = np.zeros((n, 16))
    plants[:, :12] = rng.normal(size=(n, 12)) * np.repeat([3.0, 1.0, 0.3, 0.5], 3)
    plants[:, 8] = rng.uniform(-3, 3, n)
    return plants


def some_messages(rng, n, K=3, plan=5):
    comm = rng.normal(size=(n, K, 15 + 6 * plan))
    comm[..., 0] = rng.choice([0.0, 1.0, 10.0], (n, K))
    comm[..., 1] = rng.choice([0.0, 0.05, 0.4, 1.3], (n, K))
    comm[..., 8:10] *= 0.3
    psi = rng.uniform(-3, 3, (n, K))
    comm[..., 10], comm[..., 11] = np.sin(psi), np.cos(psi)
    comm[comm[..., 0] == 0.0] = 0.0
    return comm


def acceleration(phi, theta, psi):
    """g e3 - (g / b3_z) b3."""
    b3 = rotation_body_from_inertial([phi, theta, psi])[2]
    return np.array([0.0, 0.0, G]) - G / max(b3[2], 0.2) * b3


def neighbour_at(message, v_i, n, kind):
    p, v, age = message[2:5], message[5:8] + v_i, message[1]
    t = age + n * DT
    if kind == "frozen":
        return p, v, np.zeros(3)
    if kind == "plan":
        stages = message[15:].reshape(-1, 6)
        q = n + round(age / DT)
        m = min(q, len(stages) - 1)
        velocity = stages[m, 3:] + v_i
        return stages[m, :3] + (q - m) * DT * velocity, velocity, np.zeros(3)
    a = np.zeros(3)
    if kind == "ca":
        a = acceleration(message[8], message[9], np.arctan2(message[10], message[11]))
    return p + v * t + a * t**2 / 2, v + a * t, a


def shorten(x, limit):
    length = np.linalg.norm(x)
    return x * limit / length if length > limit else x


def twin(plant, comm, options, N, target=None):
    """Section 4 and 9 as they are written down, one vehicle."""
    v_i = rotation_body_from_inertial(plant[6:9]).T @ plant[3:6]
    messages = [m for m in comm if m[0] > 0.0]
    r, w, b = np.zeros(3), v_i if messages else np.zeros(3), np.zeros(3)
    if messages and options.neighbour == "ca":
        b = acceleration(*plant[6:9])
    total = 1.0 + sum(m[0] for m in messages)
    rows, tilts = [np.r_[0, 0, 0, v_i, 0, 1]], [np.zeros(2)]
    for n in range(1, N + 1):
        if options.feed_forward:
            r, w = r + w * DT + b * DT**2 / 2, w + b * DT
        for m in messages:
            p_j, v_j, a_j = neighbour_at(m, v_i, n, options.neighbour)
            r, w, b = r + m[0] * (p_j + m[12:15]), w + m[0] * v_j, b + m[0] * a_j
        r, w, b = r / total, w / total, b / total
        if target is not None:
            r_t, v_t, P_t, slot = target
            A, B = np.eye(3) / options.formation_weight, np.linalg.inv(P_t)
            M = np.linalg.inv(A + B)
            ahead = n * DT if options.target == "cv" else 0.0
            r, w = M @ (A @ r + B @ (r_t + ahead * v_t + slot)), M @ (A @ w + B @ v_t)
        rows.append(np.r_[shorten(r, options.reach), shorten(w, options.speed), 0, 1])
        c, s = np.cos(plant[8]), np.sin(plant[8])
        theta = -np.arctan((b[0] * c + b[1] * s) / (G - b[2]))
        phi = np.arctan((b[1] * c - b[0] * s) * np.cos(theta) / (G - b[2]))
        tilts.append(np.array([phi, theta]) if options.attitude else np.zeros(2))
    return np.array(rows), np.array(tilts)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("N", [1, 5, 8])
def test_compiled_references_equal_their_numpy_twin(variant, N):
    rng, options = np.random.default_rng(N), ConsensusOptions(**VARIANTS[variant])
    plants, comm = some_plants(rng, 8), some_messages(rng, 8)
    found = consensus_reference(plants, comm, horizon=N, options=options)
    for i in range(8):
        window, attitude = twin(plants[i], comm[i], options, N)
        np.testing.assert_allclose(found.window[i], window, atol=1e-11)  # round-off of sums over stages
        np.testing.assert_allclose(found.attitude[i], attitude, atol=1e-11)


@pytest.mark.parametrize("model", ["cv", "frozen"])
def test_fused_references_recurse_on_the_fused_point(model):
    rng, options = np.random.default_rng(0), ConsensusOptions(target=model, formation_weight=0.3)
    plants, comm = some_plants(rng, 8), some_messages(rng, 8)
    L = rng.normal(size=(8, 3, 3))
    target = rng.normal(size=(8, 3)), rng.normal(size=(8, 3)), L @ L.mT + 0.01 * np.eye(3), np.ones((8, 3))
    found = consensus_reference(plants, comm, options=options, target=TargetEstimate(*target))
    for i in range(8):
        window, _ = twin(plants[i], comm[i], options, 5, [part[i] for part in target])
        np.testing.assert_allclose(found.window[i], window, atol=1e-11)


def test_ignorance_of_the_target_leaves_the_formation_and_certainty_the_target():
    rng, options = np.random.default_rng(1), ConsensusOptions(**FREE)
    plants, comm = some_plants(rng, 4), some_messages(rng, 4)
    r, v, slot = rng.normal(size=(3, 4, 3))
    unknown = TargetEstimate(r, v, np.tile(1e12 * np.eye(3), (4, 1, 1)), slot)
    formation = consensus_reference(plants, comm, options=options).window
    fused = consensus_reference(plants, comm, options=options, target=unknown).window
    np.testing.assert_allclose(fused, formation, atol=1e-10)
    known = consensus_reference(
        plants, comm, options=options, target=unknown._replace(P=np.zeros((4, 3, 3)))
    ).window
    ahead = DT * np.arange(1, 6)[:, None]
    np.testing.assert_allclose(known[:, 1:, :3], (r + slot)[:, None] + ahead * v[:, None], atol=1e-12)
    np.testing.assert_allclose(known[:, 1:, 3:6], np.broadcast_to(v[:, None], (4, 5, 3)), atol=1e-12)


def test_a_vehicle_that_hears_nobody_holds_its_position():
    plants = some_plants(np.random.default_rng(2), 3)
    for comm in (np.zeros((3, 2, 15)), np.zeros((3, 0, 15))):
        window = consensus_reference(plants, comm).window
        assert not window[:, 1:, :6].any()
        np.testing.assert_array_equal(window[:, :, 7], 1.0)


def test_a_leader_follows_its_preview_within_the_governor():
    rng = np.random.default_rng(3)
    plants, comm, preview = some_plants(rng, 2), some_messages(rng, 2), 5.0 * rng.normal(size=(2, 7, 8))
    found = consensus_reference(plants, comm, leader=[True, False], preview=preview).window
    expected = preview[0, :6].copy()
    for row in expected:
        row[:3], row[3:6] = shorten(row[:3], 1.0), shorten(row[3:6], 2.0)
    np.testing.assert_allclose(found[0], expected, atol=1e-14)
    np.testing.assert_array_equal(found[1], consensus_reference(plants[1:], comm[1:]).window[0])


@pytest.mark.parametrize("variant", ["default", "plan"])
def test_an_old_message_of_a_steady_vehicle_tells_as_much_as_a_fresh_one(variant):
    rng, options = np.random.default_rng(4), ConsensusOptions(**VARIANTS[variant])
    plants = some_plants(rng, 1)
    v_i = rotation_body_from_inertial(plants[0, 6:9]).T @ plants[0, 3:6]
    v_j, p_j = rng.normal(size=(2, 3))
    comm = np.zeros((2, 1, 15 + 30))
    for row, age in enumerate((0.0, 0.6)):
        comm[row, 0, :8] = np.r_[1.0, age, p_j - age * v_j, v_j - v_i]
        plan = [np.r_[p_j + (q * DT - age) * v_j, v_j - v_i] for q in range(5)]
        comm[row, 0, 15:] = np.ravel(plan)
    fresh, old = consensus_reference(np.repeat(plants, 2, axis=0), comm, options=options).window
    np.testing.assert_allclose(old, fresh, atol=1e-13)


def test_without_a_plan_yet_a_neighbour_keeps_its_velocity():
    rng = np.random.default_rng(5)
    plants, comm = some_plants(rng, 3), some_messages(rng, 3)
    comm[..., 15:] = 0.0
    planned = consensus_reference(plants, comm, options=ConsensusOptions(neighbour="plan"))
    np.testing.assert_array_equal(planned.window, consensus_reference(plants, comm).window)


def test_the_order_of_the_slots_does_not_matter():
    rng = np.random.default_rng(6)
    plants, comm = some_plants(rng, 4), some_messages(rng, 4, K=5)
    shuffled = comm[:, rng.permutation(5)]
    np.testing.assert_allclose(
        consensus_reference(plants, comm).window, consensus_reference(plants, shuffled).window, atol=1e-13
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"neighbour": "fast"}, "neighbour must be one of 'cv', 'frozen', 'ca', 'plan', got 'fast'"),
        ({"target": "ca"}, "target must be one of"),
        ({"attitude": True}, "attitude needs the neighbours' accelerations: set neighbour='ca'"),
        ({"reach": 0.0}, "reach must be > 0"),
        ({"speed": float("nan")}, "speed must be > 0"),
        ({"formation_weight": np.inf}, "formation_weight must be finite"),
    ],
)
def test_an_option_that_is_not_allowed_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        ConsensusOptions(**options)


def test_wrong_shapes_and_missing_plans_are_named():
    plants = np.zeros((2, 16))
    with pytest.raises(ValueError, match="a comm slot has 15 numbers"):
        consensus_reference(plants, np.zeros((2, 1, 14)))
    with pytest.raises(ValueError, match="needs plans in the messages"):
        consensus_reference(plants, np.zeros((2, 1, 15)), options=ConsensusOptions(neighbour="plan"))
    with pytest.raises(ValueError, match=r"plant must be \(n, 16\)"):
        consensus_reference(np.zeros((2, 12)), np.zeros((2, 1, 15)))
    with pytest.raises(ValueError, match="preview must be"):
        consensus_reference(plants, np.zeros((2, 1, 15)), preview=np.zeros((2, 3, 8)))
