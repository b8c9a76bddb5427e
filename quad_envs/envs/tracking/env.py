"""One quadrotor follows a reference: the single environment."""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ...episode_limit import steps_asked
from ...lanes import N_PLANT, PLANT
from ...plant import Array
from ...references.table_row import N_REFERENCE
from ...tasks import Task
from ..shared.actions import FLOAT32, real_numbers
from ..shared.render_modes import NO_RENDERING, RenderModes, checked_rendering
from ..shared.specified import Specified
from .batch import TrackingBatch
from .kernel import N_TOLD
from .options import TrackingOptions

if TYPE_CHECKING:
    from ..pictures import TrackingPictures

Observation = NDArray[np.float32]
_Step = tuple[Observation, float, bool, bool, dict[str, Any]]

# What the kernel tells of a single flight, see `kernel.N_TOLD`: reward, stage cost, cost, episode cost;
# clipped actions, cause; crashed, truncated, violated.
_unpack = Struct("4d2q3?5x").unpack_from
_ONE = np.zeros(1, dtype=np.int64)


class TrackingEnv(Specified, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A quadrotor follows a reference trajectory within limits.

    ## Description
    The plant is the 12-state rigid body of Ru (2017) with first-order rotors, z down, integrated by RK4 with
    the rotor lag in closed form. The registered ids differ in their default reference, start and limits only.

    ## Action Space
    `Box(-1, 1, (4,), float32)`: rotor force commands. -1 is no force, 0 hover (m g / 4), +1 kappa m g; linear
    in between. A non-finite action raises ValueError; one outside the box is clipped and counted
    (`info["clipped_actions"]`).

    ## Observation Space
    One flat float32 Box, see `quad_envs.observations`: `env.unwrapped.task.layout.slices` names the parts and
    `layout.decode` takes them apart. It holds the vehicle's own state, the last command and the coming
    reference relative to the vehicle.

    ## Rewards
    `(1 - v) / (1 + l)` with the stage cost l = |x - x_ref|_Q^2 + |u - u_T|_R^2 and v in [0, 1] the violation
    of the limits; 0 in the step of a crash. `reward="quadratic"` gives -l - v instead.

    ## Starting State
    Hover at `start`, each component drawn from +- `start_box`. `reset(options={"state": x})` puts the plant
    elsewhere.

    ## Episode Termination
    Crash: |roll| or |pitch| >= 85 degrees, farther than `lost_distance` from the reference, or a state that
    is no longer finite (or above 1e30). Truncation after `time_limit`.

    ## Info
    At every step and at reset: `cost` (sum of hinge / scale over the limits), `episode_cost` (its running
    sum), `constraint_violation` (bool), `constraint_values` (value minus limit of each of
    `task.constraint_names`), `stage_cost`, `crashed`, `crash_cause` (place in `task.crash_causes`: 0 none,
    2 "tilt", 4 "not finite", 5 "lost"), `clipped_actions`.

    ## Arguments
    Vehicle: `vehicle` (a name of `quad_envs.vehicles.VEHICLES`, whose values the others override), `frame`
        "plus" or "x", `mass` 0.8 kg, `gravity` 9.8 m/s^2, `inertia` (0.0224, 0.0224, 0.0436) kg m^2, `arm`
        0.165 m, `yaw_moment` 0.002167 m, `rotor_rate` 50 1/s, `drag` 0 kg/s.
    Limits: `kappa` 1 (largest rotor force as a fraction of the weight, in (1/4, 20]; one number, or one per
        rotor), and `tilt_limit`, `velocity_limit` and the others of `quad_envs.limits.LimitOptions`, which
        says what each bounds. No limit but kappa by default.
    Task: `reference` (a name, or whatever `quad_envs.references.make_reference` takes), `start` (3 or 12
        numbers, or "reference": on it, with its velocity and heading), `start_box` (half widths: 1 or 3
        numbers of the position or 12 of the state; 1 m, on the reference 0), `time_limit` 10 s (or
        "reference": as long as that is given) or `max_episode_steps`, as in `gymnasium.make`, `dt` 0.05 s,
        `substeps` 5, `preview` 25 stages of the reference in the observation, `Q` and `R` (diagonals, 1),
        `reward` "bounded" or "quadratic", `lost_distance` 50 m.
    Uncertainty: `disturbance` (None, a name, a force, or whatever `make_disturbance` takes),
        `reveal_disturbance` (puts its mean over the coming period into the observation), `sensor_noise`
        (standard deviations of position m, velocity m/s, attitude rad, rates rad/s, or one number for all),
        `randomize` (relative spread of mass, inertia, arm, kappa, rotor_rate, drag at reset: a mapping or
        one number for all; the largest principal moment is at most the sum of the others).

    Rendering: `render_mode` None or "rgb_array" (`gymnasium.make` makes "human" of it), `render_size`
        (640, 480) pixels.

    ## References
    G. Ru, Nonlinear Model Predictive Control for Cooperative Control and Estimation, 2017, chapters 2 to 4.
    """

    metadata = {"render_modes": RenderModes(["rgb_array"]), "render_fps": 20}  # noqa: RUF012 (Gymnasium's own form)

    def __init__(
        self, render_mode: str | None = None, render_size: tuple[int, int] = (640, 480), **kwargs: Any
    ) -> None:
        size = checked_rendering(render_mode, ("rgb_array",), render_size)
        if "threads" in kwargs:
            raise TypeError("one flight has nothing to share: threads is an argument of gymnasium.make_vec")
        asked = steps_asked()
        if asked is not None:
            kwargs["max_episode_steps"] = asked
        self.render_mode = render_mode
        self._batch = TrackingBatch(TrackingOptions.from_kwargs(kwargs), 1)
        self._pictures: TrackingPictures | None = None
        if render_mode:
            from ..pictures import TrackingPictures  # not needed by who trains and measures

            self._pictures = TrackingPictures(self._batch, 0, size)
        self._size = self.task.layout.size
        self._bind()
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self._size,), np.float32)

    def _bind(self) -> None:
        """Where the kernel tells its scores, and views of it, which take longer to make than to read."""
        self._told = self._batch.fresh_scores()
        self._values, self._memory = self._told[N_TOLD:, 0], self._told.data

    def __getstate__(self) -> dict[str, Any]:
        views = ("_told", "_values", "_memory")
        return {key: value for key, value in self.__dict__.items() if key not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._bind()

    @property
    def options(self) -> TrackingOptions:
        """The arguments of the environment as a value."""
        return self._batch.options

    @property
    def task(self) -> Task:
        """What is known of the task before the flight: from this, policies are built."""
        return self._batch.task

    @property
    def state(self) -> Array:
        """Copy of the plant [p, V_B, Theta, Omega, F], (16,), for study and tests; policies never see it."""
        return np.asarray(self._batch.vehicles.read(PLANT, N_PLANT)[0])

    @property
    def reference(self) -> Array:
        """Copy of this episode's reference rows from the start on, (n_steps, 8). For study and tests."""
        return np.array(self._batch.references[0, :, :N_REFERENCE])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; `options={"state": x}` with 12 or 16 numbers sets the plant."""
        super().reset(seed=seed)
        observation = np.empty(self._size, np.float32)
        state = self._batch.given_states(options)
        states = None if state is None else state[None]
        self._batch.begin(_ONE, [self.np_random], observation, self._told, states)
        if self._pictures:
            self._pictures.record()
        return observation, self._answer(observation)[-1]

    def step(self, action: NDArray[np.float32]) -> _Step:
        """Hold the rotor commands over one control period."""
        if self._np_random is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if action.__class__ is not np.ndarray or action.dtype is not FLOAT32:
            action = real_numbers(action, "action must be 4 numbers, one per rotor")
        actions = np.ascontiguousarray(action)
        if actions.shape != (4,):
            raise ValueError(f"action must have shape (4,), one entry per rotor, got {actions.shape}")
        observation = np.empty(self._size, FLOAT32)
        self._batch.step(actions, observation, self._told)
        if self._pictures:
            self._pictures.record()
        return self._answer(observation)

    def render(self) -> NDArray[np.uint8] | None:
        """The picture of the present moment, (height, width, 3), with `render_mode="rgb_array"`."""
        if self._pictures is None:
            gymnasium.logger.warn(NO_RENDERING)
            return None
        return self._pictures.frame()

    def _answer(self, observation: Observation) -> _Step:
        """What a step returns, from what the kernel told."""
        reward, loss, cost, total, clipped, cause, crashed, truncated, violated = _unpack(self._memory)
        values = self._values
        info = {
            "cost": cost,
            "episode_cost": total,
            "constraint_violation": violated,
            "constraint_values": values.copy() if values.size else values,  # nobody can change no numbers
            "stage_cost": loss,
            "crashed": crashed,
            "crash_cause": cause,
            "clipped_actions": clipped,
        }
        return observation, reward, crashed, truncated, info
