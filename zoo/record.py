"""Film a trained team: ``sb3-e2c record --algo e2c_t --env MultiRover-6-3-v0 -o team.mp4``.

With --every-checkpoint the film shows the same episode played by each checkpoint of the run, with
its number of training steps above the picture. As in enjoy, a model is rebuilt from the run's
config.yml and only weights are read from its file (unless you --trust it).
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import imageio
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm

from sb3_e2c import MAPPO
from sb3_e2c.saving import atomic_write
from sb3_e2c.zoo.console import (
    ConsoleParser,
    StoreDict,
    UserError,
    brief,
    check_device,
    check_file,
    one_line_errors,
)
from sb3_e2c.zoo.runs import (
    Run,
    add_run_flags,
    check_seed,
    checkpoint_name,
    checkpoint_steps,
    find_run,
    load_model,
    make_env,
)


def make_parser() -> ConsoleParser:
    """The flags of ``record``."""
    parser = ConsoleParser(
        prog="sb3-e2c record",
        description=(__doc__ or "").split("\n\n")[1],
        examples=[
            "sb3-e2c record --algo e2c_t --env MultiRover-6-3-v0 -o team.mp4 --n-episodes 3",
            "sb3-e2c record --algo e2c_t --env MultiRover-6-3-v0 -o gain.gif --every-checkpoint",
        ],
    )
    add, switch = parser.add_argument, "store_true"
    add_run_flags(parser)
    add("-o", "--out", type=Path, required=True, metavar="FILE", help="the film (.gif or .mp4)")
    add("--n-episodes", type=int, default=1, help="episodes of each model (default: 1)")
    add("--every-checkpoint", action=switch, help="film every checkpoint of the run, in order")
    add("--deterministic", action=switch, help="take the most likely actions (default: sample)")
    add("--seed", type=int, default=0, help="of worlds and sampled actions (default: 0)")
    add("--env-kwargs", nargs="+", action=StoreDict, metavar="KEY:VALUE", help="changed arguments")
    add("--device", default="auto", help="torch device (default: auto)")
    add("--trust", action=switch, help="unpickle the model: it can then execute code")
    add("--verbose", type=int, default=1, help="0: print nothing")
    return parser


def _check(args: argparse.Namespace) -> None:
    if args.n_episodes < 1:
        raise UserError(f"--n-episodes is {args.n_episodes}; expected at least 1")
    for flag in ("load_best", "load_checkpoint"):
        if args.every_checkpoint and getattr(args, flag):
            raise UserError(f"--every-checkpoint and --{flag.replace('_', '-')}: give one of them")
    check_seed(args.seed)
    check_device(args.device)
    check_video(args.out, "--out")


def check_video(path: Path | None, flag: str) -> None:
    """Raise :class:`UserError` unless a film of that name can be written.

    :param path: The file, if one is asked for
    :param flag: The flag that named it
    """
    check_file(path, flag)
    if path is not None and path.suffix not in (".gif", ".mp4"):
        raise UserError(f"{flag} is {path}; expected a name that ends in .gif or .mp4")


def record(args: argparse.Namespace) -> int:
    """Write the film.

    :param args: See :func:`make_parser`
    :return: How many models it shows
    """
    _check(args)
    every = args.every_checkpoint
    flags = {**vars(args), "load_last_checkpoint": every or args.load_last_checkpoint}
    run = find_run(argparse.Namespace(**flags))
    films = checkpoints(run) if every else [("", run)]
    with closing(_make_stage(run, args)) as env:
        fps = _frames_per_second(env)
    write_video(
        (frame for title, shown in films for frame in _film(shown, title, args)), args.out, fps
    )
    return len(films)


def checkpoints(run: Run) -> list[tuple[str, Run]]:
    """Titles and checkpoints of a run, in the order of training.

    :param run: One of its models
    """
    return [
        (
            f"trained for {steps:,} agent steps",
            replace(run, model_path=run.folder / checkpoint_name(steps)),
        )
        for steps in checkpoint_steps(run.folder)
    ]


def _make_stage(run: Run, args: argparse.Namespace) -> VecEnv:
    """One world that draws pictures; each call makes the same one."""
    kwargs = {**(args.env_kwargs or {}), "render_mode": "rgb_array"}
    return make_env(run, 1, args.seed, kwargs, args.trust)


def _film(run: Run, title: str, args: argparse.Namespace) -> Iterator[np.ndarray]:
    """Frames of one model, with its title if it has one."""
    with closing(_make_stage(run, args)) as env:
        # seeded here: every model begins with the same random numbers for its actions
        model = load_model(run, env, args.seed, args.device, args.trust)
        for frame in film(model, env, args.n_episodes, args.deterministic):
            yield add_title(frame, title) if title else frame


def film(model: MAPPO, env: VecEnv, n_episodes: int, deterministic: bool) -> Iterator[np.ndarray]:
    """Pictures of the first world, up to the end of an episode.

    :param model: The team
    :param env: Worlds with ``render_mode="rgb_array"``
    :param n_episodes: How many episodes
    :param deterministic: Whether it takes the most likely actions
    :return: RGB images, uint8, shape (height, width, 3) each
    """
    observations: Any = env.reset()
    state = None
    starts = np.ones(env.num_envs, dtype=bool)
    yield _picture(env)
    while True:
        actions, state = model.predict(observations, state, starts, deterministic)
        observations, _, starts, _ = env.step(actions)
        n_episodes -= int(starts[0])  # the worlds show their next episode already
        if n_episodes == 0:
            return
        yield _picture(env)


def _picture(env: VecEnv) -> np.ndarray:
    try:
        image = env.get_images()[0]
    except Exception as error:  # whatever a graphics library without a screen may raise
        raise UserError(f"this environment cannot be filmed here: {brief(error)}") from error
    if image is None:
        raise UserError("this environment cannot be filmed: it has no rgb_array rendering")
    return image


def add_title(frame: np.ndarray, title: str) -> np.ndarray:
    """The picture under a bar with a line of text.

    :param frame: RGB image, uint8, shape (height, width, 3)
    :param title: The text
    :return: Shape (height + height of the bar, width, 3)
    """
    from PIL import Image, ImageDraw, ImageFont  # of the extra that renders environments

    height, width, _ = frame.shape
    size = max(12, height // 28)
    bar = Image.new("RGB", (width, 2 * size), "white")
    font = ImageFont.load_default(size)
    ImageDraw.Draw(bar).text((size, size), title, fill="black", font=font, anchor="lm")
    return np.concatenate([np.asarray(bar), frame])


def record_episode(
    model: MAPPO, env: VecEnv, path: Path, deterministic: bool, progress: bool = False
) -> None:
    """Film one episode of the first world.

    :param model: The team
    :param env: Worlds with ``render_mode="rgb_array"``
    :param path: A name that ends in .gif or .mp4
    :param deterministic: Whether it takes the most likely actions
    :param progress: Whether to count the pictures
    """
    frames = film(model, env, 1, deterministic)
    with closing(tqdm(frames, unit=" pictures", disable=not progress)) as counted:
        write_video(counted, path, _frames_per_second(env))


def _frames_per_second(env: VecEnv) -> float:
    return env.get_attr("metadata")[0].get("render_fps", 10)


def write_video(frames: Iterable[np.ndarray], path: Path, fps: float) -> None:
    """Write a film, one frame at a time: a long one need not fit into memory.

    :param frames: RGB images of one size, uint8, shape (height, width, 3)
    :param path: A name that ends in .gif or .mp4
    :param fps: Frames in a second
    """
    # By default imageio stretches films to multiples of 16 pixels.
    options: dict[str, float] = {"fps": fps, "macro_block_size": 2}
    if path.suffix == ".gif":
        options = {"duration": 1000 / fps, "loop": 0}
    with atomic_write(path) as file, _open_film(file, path.suffix, **options) as writer:
        for frame in frames:
            writer.append_data(frame)


def _open_film(file: BinaryIO, suffix: str, **options: float) -> Any:
    return imageio.get_writer(file, format=suffix, mode="I", **options)


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c record``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        n_models = record(args)
        if args.verbose > 0:
            checkpoints_ = f" ({n_models} checkpoints)" if args.every_checkpoint else ""
            print(f"{args.out}{checkpoints_}")


if __name__ == "__main__":
    main()
