"""Several quadrotors fly in formation behind a leader (chapter 5)."""

from __future__ import annotations

from .env import TeamEnv
from .options import FormationOptions


class FormationEnv(TeamEnv):
    """N quadrotors take their slots behind a leader and keep them, each from its own observation.

    ## Description
    `quad_0` leads along a reference that only it knows. Every vehicle hears its neighbours in a communication
    graph and senses whoever is near. All move at once; the vehicles are those of the tracking tasks.

    ## Action Space
    Of each agent `Box(-1, 1, (4,), float32)`: rotor force commands as in the tracking tasks. With
    `comm="plan"` `Box(-1, 1, (4 + 6 preview,), float32)`: the tail is the own plan p, v at the coming
    `preview` steps, relative to the present position, in units of 5 m and 5 m/s; the neighbours hear it one
    step later.

    ## Observation Space
    Of each agent one flat float32 Box, see `quad_envs.observations.team`: `env.task.layout.slices` names the
    parts and `layout.decode` takes them apart. Its length does not depend on the number of vehicles, but for
    a default of 5 comm and sensed slots up to 6 vehicles and 8 beyond.

    ## Rewards
    Of each agent `(1 - v) / (1 + l)`, l = |x - x*|_Q^2 + |u - u_T|_R^2 + w mean_j |p_i - p_j - delta_ij|^2,
    with x* the own slot beside the leader's reference, j the neighbours in the graph, and v in [0, 1] the
    violation of the limits and of the separation. A crash gives 0: to everybody with `terminate="team"`.

    ## Starting State
    Hover at `start`. `reset(options={"state": x})` with (N, 12) or (N, 16) numbers puts the plants elsewhere.

    ## Episode Termination
    Crash: two vehicles nearer than `crash_distance`, |roll| or |pitch| >= 85 degrees, farther than `arena`
    from the origin, or a state that is not finite. Truncation after `time_limit` (or `max_cycles` steps).

    ## Info
    Of each agent, at every step and at reset: the keys of the tracking tasks (`cost`, `episode_cost`,
    `constraint_violation`, `constraint_values`, `stage_cost`, `crashed`, `clipped_actions`), and
    `crash_cause` (place in `task.crash_causes`: 1 "distance", 2 "tilt", 3 "arena", 4 "not finite" for who
    crashed, else 0; `crashed` is for all whose episode it ends), `formation_error` (m, distance to the slot),
    `min_separation` (m, smallest distance to another vehicle over the substeps; 2 arena when nobody else
    flies), `messages` (received in this step), `reward_terms` (parts of l, then violation / scale of each
    limit: `task.reward_term_names`).

    ## Arguments
    Vehicle, limits, weights, uncertainty, `dt`, `substeps`, `reward`: see `TrackingEnv`; `tilt_limit` 1.2.
    Team: `vehicles` 6 (2 to 200), `formation` "lattice", "triangle", "hexagon" or (N, 3) offsets, `spacing`
        1 m, `start` "random", "line", "sorted", "box" or (N, 3), `separation` d_s 0.4 m, `crash_distance`
        0.33 m (both follow another arm: 2 arm, and 0.07 m more but at least 0.4), `sensing_radius` 2 m,
        `sensed` slots, `terminate` "team" or "agent", `arena` 100 m.
    Communication: `graph` "weak", "strong", "chain", "ring", "star", "complete", "switching", a matrix (row
        i is what i hears), edges (sender, receiver), a graph of networkx, a `Switching` or `Timed` schedule
        or a function of the step; `leader_weight` 10 of a link toward the leader where weights are 1,
        `drop_out` probability, `delay` steps, `message_lifetime` 2 s for which the last message stays valid,
        `neighbours` slots, `comm` "state" or "plan".
    Task: `reference` of the leader ("line", "setpoint", "fast-line", "slow-helix", any of the suite's),
        `preview` 5 stages of it, `formation_weight` w 1, `time_limit` 20 s or `max_cycles` steps.

    Rendering: `render_mode` None, "rgb_array" or "human" (a window, needs the extra `human`), `render_size`
        (640, 480) pixels.

    ## References
    G. Ru, Nonlinear Model Predictive Control for Cooperative Control and Estimation, 2017, chapter 5.
    """

    options_type = FormationOptions
