"""Console command ``sb3-e2c train|enjoy|...``; see ``COMMANDS``."""

import importlib
import sys
from collections.abc import Sequence

COMMANDS = {
    "train": "train a team",
    "enjoy": "evaluate a trained team",
    "record": "film a trained team, or what it learned",
    "export": "write the actor as an ONNX file, to act without torch",
    "push": "publish a trained team on the Hugging Face hub",
    "load": "fetch a team from the Hugging Face hub",
    "demo": "train, evaluate and film one team in a few minutes",
    "benchmark": "run the experiments of a suite, on one machine or many",
    "crossplay": "play the teams of a benchmark against each other's adversaries",
    "plot": "draw the curves of a run, or the figures of a benchmark",
    "tune": "search for hyperparameters",
    "speed": "train beside other libraries and compare the speed",
    "stepping": "step an environment beside other ways to step it",
    "completion": "print a script that completes flags in bash or zsh",
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command.

    :param argv: The command and its flags; default: those of this process
    """
    try:
        _run(*(sys.argv[1:] if argv is None else argv))
    except KeyboardInterrupt:  # while it imports its libraries; later a command takes care itself
        print("sb3-e2c: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def _run(command: str = "--help", *flags: str) -> None:
    if command in ("-h", "--help"):
        print("usage: sb3-e2c COMMAND [FLAGS]; COMMAND --help shows its flags and examples\n")
        print("\n".join(f"  {name:<10} {text}" for name, text in COMMANDS.items()))
    elif command not in COMMANDS:
        console = importlib.import_module("sb3_e2c.zoo.console")
        console.fail(console.unknown("command", command, COMMANDS))
    else:
        importlib.import_module(f"sb3_e2c.zoo.{command}").main(flags)


if __name__ == "__main__":
    main()
