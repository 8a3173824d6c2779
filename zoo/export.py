"""Export a trained actor: ``sb3-e2c export --algo e2c_t --env MultiRover-6-3-v0 -o actor``.

Writes the network that one agent needs to act as actor.onnx, and what one must know to use it as
card.json. The network is compared with torch over whole episodes before anything is written. As in
enjoy, a model is rebuilt from the run's config.yml and only weights are read from its file (unless
you --trust it).

Shapes: B rows, each an agent; D observation size, A action size, H hidden units of the GRU.
"""

import argparse
import hashlib
import io
import json
import platform
import sys
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed
from torch import nn
from torch.nn import functional as F

import sb3_e2c
from sb3_e2c import MAPPO
from sb3_e2c.zoo.configuration import team_limits
from sb3_e2c.zoo.console import (
    ConsoleParser,
    UserError,
    brief,
    check_writable,
    one_line_errors,
    write_whole,
)
from sb3_e2c.zoo.runs import Run, add_run_flags, check_seed, find_run, load_model, make_env

FORMAT_VERSION = 1
OPSET = 17  # of onnxruntime 1.12 and later
TOLERANCE = 1e-5
CHECKED_WORLDS = 4  # an episode of each is compared with torch

_PACKAGES = ("sb3_e2c", "stable_baselines3", "torch", "onnx", "onnxruntime", "numpy")


def make_parser() -> ConsoleParser:
    """The flags of ``export``."""
    parser = ConsoleParser(
        prog="sb3-e2c export",
        description=(__doc__ or "").split("\n\n")[1],
        examples=[
            "sb3-e2c export --algo e2c_t --env MultiRover-6-3-v0 -f logs --load-best -o actor",
            "# docs/export.md drives an agent with the two files, onnxruntime and numpy",
        ],
    )
    add = parser.add_argument
    add_run_flags(parser)
    add(
        "-o",
        "--out",
        type=Path,
        metavar="FOLDER",
        help="where actor.onnx and card.json shall be (default: the run's folder, export)",
    )
    add("--seed", type=int, default=0, help="of the episodes that are compared (default: 0)")
    add("--trust", action="store_true", help="unpickle the model: it can then execute code")
    add("--verbose", type=int, default=1, help="0: print nothing")
    return parser


# ---------------------------------------------------------------------------- the exported network


class Actor(nn.Module):
    """What one agent needs to act, from raw observation to action and distribution.

    :param model: A trained team
    """

    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    deviation: th.Tensor

    def __init__(self, model: MAPPO):
        super().__init__()
        self.policy: Any = model.policy
        space = model.action_space
        self.parts = _parts(self.policy.action_dist, space)
        self.action_shape = space.shape or ()
        if isinstance(space, spaces.Box):
            self.register_buffer("low", th.as_tensor(space.low, dtype=th.float32))
            self.register_buffer("high", th.as_tensor(space.high, dtype=th.float32))
        normalizer = model.get_vec_normalize_env()
        self.normalizer = normalizer if normalizer is not None and normalizer.norm_obs else None
        if self.normalizer is not None:  # in double precision, as VecNormalize itself
            rms: Any = self.normalizer.obs_rms
            deviation = np.sqrt(rms.var + self.normalizer.epsilon)
            self.register_buffer("mean", th.as_tensor(rms.mean, dtype=th.float64))
            self.register_buffer("deviation", th.as_tensor(deviation, dtype=th.float64))

    @property
    def memory(self) -> dict[str, list[int]]:
        """Names of the hidden states, and the shapes that they have for one agent."""
        return {"state": [self.policy.gru_hidden_size]} if self.policy.recurrent else {}

    @property
    def outputs(self) -> list[str]:
        """Names of what :meth:`forward` returns."""
        distribution = ["logits"] if self.parts else ["mean", "log_std"]
        return ["action", *distribution, *(f"next_{name}" for name in self.memory)]

    def forward(self, observation: th.Tensor, state: th.Tensor | None = None) -> Any:
        """One step of B agents.

        :param observation: As the environment gives it, shape (B, *D)
        :param state: Hidden states, zero at the start of an episode, shape (B, H)
        :return: Most likely actions (B, *A), then logits (B, sum of choices) or means and
            logarithms of the standard deviations (B, *A), then the next hidden states (B, H)
        """
        latent = self.policy.mlp_extractor.forward_actor(self._features(observation))
        if state is None:
            return self._act(latent)
        state = _gru_step(self.policy.actor_gru, latent, state)
        return (*self._act(state), state)

    def _features(self, observation: th.Tensor) -> th.Tensor:
        if self.normalizer is not None:
            limit = self.normalizer.clip_obs
            scaled = (observation.double() - self.mean) / self.deviation
            observation = scaled.clip(-limit, limit).float()
        policy = self.policy
        return BasePolicy.extract_features(policy, observation, policy.pi_features_extractor)

    def _act(self, latent: th.Tensor) -> tuple[th.Tensor, ...]:
        output = self.policy.action_net(latent)
        if self.parts:
            logits = [F.log_softmax(part, dim=1) for part in output.split(self.parts, dim=1)]
            actions = th.stack([part.argmax(dim=1) for part in logits], dim=1)
            return actions.reshape(-1, *self.action_shape), th.cat(logits, dim=1)
        mean = output if len(self.action_shape) == 1 else output.reshape(-1, *self.action_shape)
        log_std = self.policy.log_std.reshape(self.action_shape)
        return mean.clip(self.low, self.high), mean, log_std + th.zeros_like(mean)


def _parts(distribution: Distribution, action_space: spaces.Space) -> list[int]:
    """How many choices each part of a discrete action has; empty for continuous actions."""
    if isinstance(distribution, CategoricalDistribution):
        return [distribution.action_dim]
    if isinstance(distribution, MultiCategoricalDistribution):
        return [int(n) for n in distribution.action_dims]
    if type(distribution) is not DiagGaussianDistribution:
        raise UserError(
            f"actions of {action_space} come from a {type(distribution).__name__}; expected a "
            "Gaussian or categorical distribution, others cannot be exported"
        )
    return []


def _gru_step(gru: nn.GRU, inputs: th.Tensor, states: th.Tensor) -> th.Tensor:
    """One step of a GRU in operations that every ONNX runtime has; see ``sb3_e2c.gru``.

    :param gru: One layer
    :param inputs: Shape (B, F)
    :param states: Hidden states before, shape (B, H)
    :return: Shape (B, H)
    """
    weights: Any = gru._flat_weights
    input_weight, weight, input_bias, bias = weights
    size = gru.hidden_size
    x_r, x_z, x_n = F.linear(inputs, input_weight, input_bias).split(size, dim=1)
    h_r, h_z, h_n = F.linear(states, weight, bias).split(size, dim=1)
    r, z = th.sigmoid(x_r + h_r), th.sigmoid(x_z + h_z)
    n = th.tanh(x_n + r * h_n)
    return n + z * (states - n)


def to_onnx(actor: Actor) -> bytes:
    """Content of the ONNX file.

    :param actor: The network
    :raises UserError: if it has a part that ONNX cannot express
    """
    inputs = ["observation", *actor.memory]
    space = actor.policy.observation_space
    observation = th.zeros(2, *(space.shape or ()), dtype=getattr(th, _input_type(space).name))
    states = [th.zeros(2, *shape) for shape in actor.memory.values()]
    file: Any = io.BytesIO()
    try:
        with th.no_grad(), warnings.catch_warnings():
            # torch's newer exporter needs one more package for the same operations
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            th.onnx.export(
                actor.eval(),
                (observation, *states),
                file,
                dynamo=False,
                opset_version=OPSET,
                input_names=inputs,
                output_names=actor.outputs,
                dynamic_axes={name: {0: "batch"} for name in [*inputs, *actor.outputs]},
            )
    except Exception as error:  # whatever a user's own features extractor may raise in there
        raise UserError(f"torch cannot express this actor in ONNX: {brief(error)}") from error
    return file.getvalue()


def _input_type(space: spaces.Space) -> np.dtype:
    """Observations are exported as single floats, or as the whole numbers that they are."""
    assert space.dtype is not None
    return np.dtype(np.float32) if np.issubdtype(space.dtype, np.floating) else space.dtype


# ---------------------------------------------------------------------------- the comparison


class Comparison(NamedTuple):
    """What was compared with torch."""

    episodes: int
    agent_steps: int
    max_difference: float


def compare(model: MAPPO, actor: Actor, content: bytes, seed: int) -> Comparison:
    """Let the ONNX file act beside torch, in the model's worlds, for an episode of each.

    Both carry their own hidden states. The actions taken are sampled, as they are in training.

    :param model: The team, with its environment
    :param actor: What was exported
    :param content: The ONNX file
    :param seed: Of the sampled actions
    :raises UserError: if they differ by more than ``TOLERANCE``, relative to numbers beyond 1
    """
    session: Any = import_module("onnxruntime").InferenceSession(
        content, providers=["CPUExecutionProvider"]
    )
    env = model.get_env()
    assert env is not None
    set_random_seed(seed)
    obs: Any = env.reset()
    state, starts = None, np.ones(env.num_envs, dtype=bool)
    memory = {n: np.zeros((len(obs), *s), np.float32) for n, s in actor.memory.items()}
    running, steps, largest = np.ones(env.num_envs, dtype=bool), 0, 0.0
    while running.any():
        raw = obs if actor.normalizer is None else actor.normalizer.get_original_obs()
        memory = {name: np.where(starts[:, None], 0, value) for name, value in memory.items()}
        feed = {"observation": np.asarray(raw, _input_type(env.observation_space)), **memory}
        found = dict(zip(actor.outputs, session.run(None, feed), strict=True))
        expected = _expected(model, actor, obs, state, starts)
        largest = max(largest, _difference(found, expected, actor.parts))
        memory = {name: found[f"next_{name}"] for name in memory}
        actions, state = model.predict(obs, state, starts, deterministic=False)
        obs, _, starts, _ = env.step(actions)
        steps += int(running.sum())
        running &= ~starts
    return Comparison(CHECKED_WORLDS, steps, largest)


def _expected(
    model: MAPPO, actor: Actor, obs: Any, state: Any, starts: np.ndarray
) -> dict[str, np.ndarray]:
    """What the model itself says, by the names of the exported outputs."""
    policy: Any = model.policy
    action, next_state = model.predict(obs, state, starts, deterministic=True)
    with th.no_grad():
        if next_state is None:
            distribution: Any = policy.get_distribution(policy.obs_to_tensor(obs)[0])
        else:
            latent = th.as_tensor(next_state[0][0], device=policy.device)
            distribution = policy._get_action_dist_from_latent(latent)
    inner = distribution.distribution
    if not actor.parts:
        numbers = [inner.mean, inner.stddev.log()]
    else:
        parts = inner if isinstance(inner, list) else [inner]
        numbers = [th.cat([part.logits for part in parts], dim=1)]
    values = [action, *(n.cpu().numpy().reshape(len(obs), -1) for n in numbers)]
    values += [] if next_state is None else [next_state[0][0]]
    return dict(zip(actor.outputs, values, strict=True))


def _difference(
    found: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray], parts: list[int]
) -> float:
    """Largest difference of any output.

    A discrete action may be another one only if it is as likely: its difference is the one between
    the logits of the two.
    """
    largest = 0.0
    for name, value in expected.items():
        other = found[name].reshape(len(value), -1)
        value = value.reshape(len(value), -1)
        if name == "action" and parts:
            value, other = _logits_of(value, expected, parts), _logits_of(other, expected, parts)
        difference = np.abs(other - value)
        if not (difference <= TOLERANCE * np.maximum(1, np.abs(value))).all():
            raise UserError(
                f"onnxruntime and torch differ by {difference.max():.2g} in {name!r}; expected at "
                f"most {TOLERANCE:g}, so nothing was written"
            )
        largest = max(largest, float(difference.max()))
    return largest


def _logits_of(
    actions: np.ndarray, outputs: Mapping[str, np.ndarray], parts: list[int]
) -> np.ndarray:
    """Logits of discrete actions, shape (B, number of parts)."""
    first = np.cumsum([0, *parts[:-1]])
    return np.take_along_axis(outputs["logits"], actions + first, axis=1)


# ---------------------------------------------------------------------------- the card


def make_card(
    run: Run, model: MAPPO, actor: Actor, content: bytes, checked: Comparison
) -> dict[str, Any]:
    """What one must know to use the actor, as plain data.

    :param run: The run
    :param model: Its model
    :param actor: What was exported
    :param content: The ONNX file
    :param checked: Its comparison with torch
    """
    space = model.observation_space
    return {
        "format": "sb3-e2c actor",
        "format_version": FORMAT_VERSION,
        "file": "actor.onnx",
        "sha256": hashlib.sha256(content).hexdigest(),
        "opset": OPSET,
        "inputs": ["observation", *actor.memory],
        "outputs": actor.outputs,
        "observation_space": describe(space) | {"dtype": _input_type(space).name},
        "action_space": describe(model.action_space),
        "memory": actor.memory,
        "normalization": _normalization(actor),
        "algo": run.algo,
        "env": run.env_id,
        "env_kwargs": run.config.get("env_kwargs") or {},
        "agents": list(model.agents),
        "cost_limits": team_limits(run.env_id, run.config),
        "constrained": bool(len(model.cost_limits)),
        "cost_scope": model.cost_scope,
        "training_steps": _training_steps(run.model_path),
        "model": run.model_path.name,
        "versions": {name: _version(name) for name in _PACKAGES}
        | {"python": platform.python_version()},
        "compared_with_torch": checked._asdict(),
    }


def describe(space: spaces.Space) -> dict[str, Any]:
    """A space as plain data; where there is no bound stands the largest number of single precision.

    :param space: Of the observations or the actions
    :raises UserError: for a space that is none of Box, Discrete and MultiDiscrete
    """
    facts: dict[str, Any] = {"type": type(space).__name__, "shape": list(space.shape or ())}
    if isinstance(space, spaces.Box):
        largest = float(np.finfo(np.float32).max)
        bounds = {"low": space.low, "high": space.high}
        return facts | {k: np.clip(v, -largest, largest).tolist() for k, v in bounds.items()}
    if isinstance(space, spaces.Discrete):
        return facts | {"n": int(space.n)}
    if isinstance(space, spaces.MultiDiscrete):
        return facts | {"nvec": space.nvec.tolist()}
    raise UserError(f"the space {space} cannot be exported; expected Box, Discrete, MultiDiscrete")


def _normalization(actor: Actor) -> dict[str, Any] | None:
    """What the ONNX file does to observations before the network."""
    if actor.normalizer is None:
        return None
    rms: Any = actor.normalizer.obs_rms
    return {
        "inside_the_file": True,
        "mean": rms.mean.tolist(),
        "variance": rms.var.tolist(),
        "epsilon": actor.normalizer.epsilon,
        "clip": actor.normalizer.clip_obs,
    }


def _training_steps(model_path: Path) -> int:
    """Agent steps that a model has learned from; plain JSON in its file, nothing is unpickled."""
    try:
        with zipfile.ZipFile(model_path) as archive:
            return int(json.loads(archive.read("data"))["num_timesteps"])
    except Exception as error:  # whatever zip files and JSON from a stranger raise
        raise UserError(f"{model_path} does not say how many steps it learned from") from error


def _version(name: str) -> str:
    return sb3_e2c.__version__ if name == "sb3_e2c" else metadata.version(name)


# ---------------------------------------------------------------------------- the command


def export(args: argparse.Namespace) -> Path:
    """Write actor.onnx and card.json.

    :param args: See :func:`make_parser`
    :return: Their folder
    """
    check_packages()
    check_seed(args.seed)
    run = find_run(args)
    folder = args.out or run.folder / "export"
    check_writable(folder, "--out")
    with closing(make_env(run, CHECKED_WORLDS, args.seed, trust=args.trust)) as env:
        model = load_model(run, env, args.seed, "cpu", args.trust)
        actor = Actor(model)
        content = to_onnx(actor)
        checked = compare(model, actor, content, args.seed)
        card = make_card(run, model, actor, content, checked)
    write_whole(folder / "actor.onnx", content)
    write_whole(folder / "card.json", json.dumps(card, indent=2, allow_nan=False) + "\n")
    if args.verbose > 0:
        print(report(run, folder, card))
    return folder


def check_packages() -> None:
    """Raise :class:`UserError` unless the packages of the extra are there."""
    for name in ("onnx", "onnxruntime"):
        try:
            import_module(name)
        except ImportError as error:
            raise UserError(f'export needs {name}: pip install "sb3-e2c[export]"') from error


def report(run: Run, folder: Path, card: Mapping[str, Any]) -> str:
    """The export for a person.

    :param run: What was exported
    :param folder: Where it is
    :param card: See :func:`make_card`
    """
    checked = card["compared_with_torch"]
    return "\n".join(
        [
            f"{run.model_path}, {card['training_steps']:,} agent steps",
            f"{folder / 'actor.onnx'}: {', '.join(card['inputs'])} -> {', '.join(card['outputs'])}",
            f"{folder / 'card.json'}",
            f"compared with torch over {checked['episodes']} episodes, "
            f"{checked['agent_steps']} agent steps: differs by at most "
            f"{checked['max_difference']:.1e}",
        ]
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c export``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        export(args)


if __name__ == "__main__":
    main()
