"""An animation of a flight: `python -m examples.animate_formation [--out formation.gif]`.

Six quadrotors close a hexagon behind a leader that flies a slow helix, each deciding from what it hears. The
frames are those of `render()`; Pillow writes them as one GIF (a picture of the documentation).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from baselines import make_policy
from quad_envs import formation_v0


def main() -> None:
    """Fly and write the animation."""
    parser = argparse.ArgumentParser(prog="python -m examples.animate_formation", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("formation.gif"), help="file to write")
    parser.add_argument("--steps", type=int, default=240, help="control steps of 0.05 s to fly")
    parser.add_argument("--every", type=int, default=4, help="control steps between frames")
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    arguments = parser.parse_args()
    team = formation_v0.parallel_env(
        vehicles=6,
        formation="hexagon",
        graph="weak",
        reference="slow-helix",
        render_mode="rgb_array",
        render_size=(640, 480),
    )
    policy, state = make_policy("consensus-mpc", team), None
    observations, _ = team.reset(seed=arguments.seed)
    frames = [team.render()]
    for step in range(arguments.steps):
        if not team.agents:
            break
        actions, state = policy.predict(np.stack([observations[name] for name in team.agents]), state)
        observations, *_ = team.step(dict(zip(team.agents, actions, strict=True)))
        if (step + 1) % arguments.every == 0:
            frames.append(team.render())
    colours = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 4)])).quantize(
        64
    )  # one palette for all
    images = [Image.fromarray(frame).quantize(palette=colours, dither=Image.Dither.NONE) for frame in frames]
    shown = round(1000 * arguments.every * 0.05 / 2.0)  # ms: twice as fast as it flies
    images[0].save(
        arguments.out, save_all=True, append_images=images[1:], duration=shown, loop=0, optimize=True
    )
    print(f"{len(frames)} frames in {arguments.out}, {arguments.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
