"""The model card of a team: README.md on the Hugging Face hub."""

import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np
from huggingface_hub import EvalResult, ModelCardData

from sb3_e2c.zoo.configuration import ALGORITHMS, merge, preset_names, resolve
from sb3_e2c.zoo.console import parse_value
from sb3_e2c.zoo.runs import Run

_TAGS = (
    *("reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3", "sb3-e2c"),
    *("multi-agent-reinforcement-learning", "safe-reinforcement-learning"),
)


def model_card(
    run: Run, args: Mapping[str, Any], results: Mapping[str, Any], repo_id: str, pictures: list[str]
) -> str:
    """The text of the card.

    :param run: The run
    :param args: What it was trained with: its args.yml
    :param results: See :func:`sb3_e2c.zoo.push.evaluate`
    :param repo_id: Where it will be
    :param pictures: Names of the pictures beside it
    """
    load = f"sb3-e2c load --repo-id {repo_id} -f logs"
    enjoy = f"sb3-e2c enjoy --algo {run.algo} --env {run.env_id} -f logs"
    parts = [
        f"---\n{_metadata(run, results)}\n---",
        f"# {run.algo} on {run.env_id}",
        f"A team of agents that was trained with sb3-e2c (`{ALGORITHMS[run.algo].__name__}`), "
        "safe multi-agent reinforcement learning for Stable-Baselines3.",
        _table(run, results),
        f"Means of {results['episodes']} episodes of the team with their standard errors; actions "
        f"are sampled, as they were in training. `{results['model']}` of the run, "
        f"evaluated with `--seed {results['seed']}`.",
        *(f"![{name}]({name})" for name in pictures),
        "## Use it",
        f"```\n{load}\n{enjoy}\n```",
        "Both read weights and plain numbers only: nothing in these files is executed.",
        "## Train it again",
        f"```\n{train_command(run, args)}\n```",
        "`config.yml` has every hyperparameter.",
        *_history(args),
    ]
    return "\n\n".join(parts) + "\n"


def _metadata(run: Run, results: Mapping[str, Any]) -> str:
    """The card's YAML, which the hub reads: tags, and results for its tables."""
    metrics = [("mean_reward", "team return", "team_return")]
    if results["team_cost"] is not None:
        metrics.append(("mean_cost", "team cost", "team_cost"))
    found = [
        EvalResult(
            task_type="reinforcement-learning",
            task_name="reinforcement-learning",
            dataset_type=run.env_id,
            dataset_name=run.env_id,
            metric_type=kind,
            metric_name=name,
            metric_value=_mean(results, key, "+/-"),
            verified=False,
        )
        for kind, name, key in metrics
    ]
    card = ModelCardData(
        library_name="stable-baselines3",
        tags=[run.env_id, *_TAGS],
        model_name=f"{run.algo}-{run.env_id}",
        eval_results=found,
    )
    return card.to_yaml().strip()


def _mean(results: Mapping[str, Any], key: str, between: str = "±") -> str:
    means, errors = np.atleast_1d(results[key]), np.atleast_1d(results[f"{key}_se"])
    pairs = zip(means, errors, strict=True)
    return ", ".join(f"{mean:.3f} {between} {error:.3f}" for mean, error in pairs)


def _table(run: Run, results: Mapping[str, Any]) -> str:
    scope = run.config.get("cost_scope") or "team"
    constrained = results["constrained"]
    rows = {"method": f"`{run.algo}`" + (f", {scope} limit" if constrained else ", no limit")}
    rows["task"] = f"`{run.env_id}`"
    rows["return of the team"] = _mean(results, "team_return")
    if results["team_cost"] is not None:
        limits = ", ".join(f"{limit:g}" for limit in results["cost_limits"]) or "unknown"
        imposed = "limit" if constrained else "not constrained; the task's limit:"
        rows["cost of the team"] = f"{_mean(results, 'team_cost')} ({imposed} {limits})"
    if results["violation_rate"] is not None:
        rows["episodes over the limit"] = f"{results['violation_rate']:.1%}"
    if results["lambda"] is not None:
        multipliers = np.atleast_1d(results["lambda"])
        rows["Lagrange multiplier λ"] = ", ".join(f"{number:.3f}" for number in multipliers)
    if "opponent" in results:
        rows["against"] = "the adversary that was trained beside it"
    rows["trained for"] = f"{results['trained_steps']:,} agent steps"
    rows["versions"] = ", ".join(f"{name} {x}" for name, x in results["versions"].items())
    return "\n".join(["| | |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())])


def _history(args: Mapping[str, Any]) -> list[str]:
    """What the command alone does not repeat."""
    notes = []
    if args.get("trained_agent"):
        notes.append("It went on from another model (`-i`), which this command does not.")
    if args.get("opponent") not in (None, "own", "random"):
        notes.append("It was trained against a saved adversary (`--opponent`).")
    if args.get("eval_env_kwargs"):
        notes.append("While it trained, it was evaluated in a changed environment.")
    return notes


# ---------------------------------------------------------------------------- the command


def train_command(run: Run, args: Mapping[str, Any]) -> str:
    """A command line that trains with the configuration of a run.

    :param run: The run
    :param args: Its args.yml
    """
    known = preset_names()
    presets = [name for name in str(args.get("preset") or "").split(",") if name in known]
    words = ["sb3-e2c", "train", "--algo", run.algo, "--env", run.env_id]
    words += ["--seed", str(args.get("seed", 0))]
    words += ["--preset", ",".join(presets)] if presets != ["headline"] else []
    words += ["--opponent", "random"] if args.get("opponent") == "random" else []
    steps = args.get("n_timesteps") or -1
    words += ["-n", str(steps)] if steps > 0 else []
    shipped = resolve(run.algo, run.env_id, presets)
    changes = [f"{key}:{_value(value)}" for key, value in _changes(shipped, run.config)]
    words += ["-params", *changes] if changes else []
    return shlex.join(words)


def _changes(
    shipped: Mapping[str, Any], config: Mapping[str, Any], outer: str = ""
) -> list[tuple[str, Any]]:
    """Dotted keys and values that lead from one configuration to another, as ``merge`` does.

    A key that only the shipped one has needs no change: naming another class removes it.
    """
    changes: list[tuple[str, Any]] = []
    start = merge(shipped, {k: v for k, v in config.items() if not isinstance(v, Mapping)})
    for key, value in config.items():
        if isinstance(value, Mapping):
            before = start.get(key)
            inner = before if isinstance(before, Mapping) else {}
            changes += _changes(inner, value, f"{outer}{key}.")
        elif key not in shipped or value != shipped[key]:
            changes.append((f"{outer}{key}", value))
    return changes


def _value(value: Any) -> str:
    """As ``-params`` reads it."""
    return value if isinstance(value, str) and parse_value(value) == value else repr(value)
