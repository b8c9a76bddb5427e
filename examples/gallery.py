"""The pictures of the documentation: `python -m examples.gallery [--out docs/gallery]`.

One flight of each environment as a frame of `render()`, and one pair: exact NMPC and a PPO network in the
corridor, from the same start, at the moment when the network breaks a limit most.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from baselines import make_policy
from baselines.policies.environments import is_parallel, make_env

_SIZE = (480, 360)
_COLOURS = 160  # of a picture; fewer turn the blue of a small vehicle grey
CORRIDOR, CORRIDOR_PAIR = "quad/CorridorTracking-v0", {"nmpc": "exact NMPC", "ppo-corridor": "PPO"}
PAIR = "nmpc-and-ppo.png"
_PAIR_SIZE, _PAIR_SEED = (560, 420), 3
_PAIR_STEPS = slice(60, 200)  # among which the moment is chosen: the trail is long by then


class Shot(NamedTuple):
    """Who flies, and when the picture is taken, s."""

    policy: str
    time: float
    options: Mapping[str, Any] = MappingProxyType({})  # of the environment


SHOTS = {
    "quad/Regulation-v0": Shot("nmpc", 0.6),
    "quad/HelixTracking-v0": Shot("nmpc", 4.0),
    "quad/SpiralTracking-v0": Shot("nmpc", 4.5),
    "quad/LineTracking-v0": Shot("nmpc", 7.0),
    "quad/LemniscateTracking-v0": Shot("nmpc", 6.0),
    "quad/RandomTracking-v0": Shot("nmpc", 4.0),
    CORRIDOR: Shot("nmpc", 5.0),
    "quad/Formation-v0": Shot("consensus-mpc", 9.0, {"vehicles": 6, "formation": "hexagon"}),
    "quad/TargetTracking-v0": Shot("cooperative-mpc", 8.0),
    "quad/CooperativeEstimation-v0": Shot("ekf", 6.0),
}


class Moment(NamedTuple):
    """What a flight shows after a step."""

    frame: NDArray[np.uint8]
    cost: float  # sum of violation / scale


def picture_name(env_id: str) -> str:
    """File of an environment's picture: `quad/HelixTracking-v0` is in helix-tracking.png."""
    name = env_id.removeprefix("quad/").removesuffix("-v0")
    return "".join(f"-{c.lower()}" if c.isupper() else c for c in name).lstrip("-") + ".png"


def fly(env: Any, policy_name: str, seed: int = 0) -> Iterator[Moment]:
    """A flight from a seed, one moment after each step, until it ends."""
    policy, state = make_policy(policy_name, env), None
    observation, _ = env.reset(seed=seed)
    if not is_parallel(env):
        ended = False
        while not ended:
            actions, state = policy.predict(observation[None], state)
            observation, _, terminated, truncated, info = env.step(actions[0])
            ended = terminated or truncated
            yield Moment(env.render(), info["cost"])
        return
    while env.agents:
        actions, state = policy.predict(np.stack([observation[name] for name in env.agents]), state)
        observation, _, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        yield Moment(env.render(), max(info["cost"] for info in infos.values()))


def shoot(env_id: str) -> Image.Image:
    """The picture of one environment."""
    shot = SHOTS[env_id]
    env = make_env(env_id, render_mode="rgb_array", render_size=_SIZE, **shot.options)
    steps = round(shot.time / env.unwrapped.task.dt)
    *_, moment = (moment for _, moment in zip(range(steps), fly(env, shot.policy), strict=False))
    env.close()
    return Image.fromarray(moment.frame)


def shoot_pair() -> Image.Image:
    """Two policies in the corridor at the same time, each below its name."""
    flights = []
    for policy in CORRIDOR_PAIR:
        env = make_env(CORRIDOR, render_mode="rgb_array", render_size=_PAIR_SIZE)
        flights.append(list(fly(env, policy, _PAIR_SEED)))
        env.close()
    costs = [moment.cost for moment in flights[-1]]
    worst = _PAIR_STEPS.start + int(np.argmax(costs[_PAIR_STEPS]))
    (width, height), strip = _PAIR_SIZE, 44
    picture = Image.new("RGB", (width * len(flights), height + strip), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(20)
    for column, (flight, title) in enumerate(zip(flights, CORRIDOR_PAIR.values(), strict=True)):
        left = column * width
        picture.paste(Image.fromarray(flight[worst].frame), (left, strip))
        share = np.mean([moment.cost > 0.0 for moment in flight])
        words = f"{title}: breaks a limit in {100.0 * share:.0f} % of its steps"
        draw.text((left + width // 2, strip // 2), words, fill="black", font=font, anchor="mm")
    return picture


def save(picture: Image.Image, path: Path) -> None:
    """Write a small PNG."""
    picture.quantize(_COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}, {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Fly and write the pictures."""
    parser = argparse.ArgumentParser(prog="python -m examples.gallery", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"), help="folder to write to")
    parser.add_argument("--only", choices=[*SHOTS, "pair"], help="one picture and not all")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for env_id in SHOTS:
        if arguments.only in (None, env_id):
            save(shoot(env_id), arguments.out / picture_name(env_id))
    if arguments.only in (None, "pair"):
        save(shoot_pair(), arguments.out / PAIR)


if __name__ == "__main__":
    main()
