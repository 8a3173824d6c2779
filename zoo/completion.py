"""Print what a shell needs to complete commands and flags: ``sb3-e2c completion bash``.

Loading the commands takes seconds, so write the script to a file once, and again after an update.
"""

import contextlib
import importlib
import io
import re
import sys
from collections.abc import Sequence

from sb3_e2c.envs import ENV_IDS
from sb3_e2c.zoo.cli import COMMANDS
from sb3_e2c.zoo.configuration import ALGORITHMS, preset_names
from sb3_e2c.zoo.console import ConsoleParser

_SCRIPT = """_sb3_e2c() {{
    local words=
    case "$COMP_CWORD:${{COMP_WORDS[COMP_CWORD-1]}}" in
        1:*) words="{commands}" ;;
        *:--algo) words="{algorithms}" ;;
        *:--env) words="{environments}" ;;
        *:--preset) words="{presets}" ;;
        *) case "${{COMP_WORDS[1]}}" in
{flags}
        esac ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _sb3_e2c sb3-e2c"""
_BEFORE = {
    "bash": "",
    "zsh": "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n",
}


def make_parser() -> ConsoleParser:
    """The arguments of ``completion``."""
    parser = ConsoleParser(
        prog="sb3-e2c completion",
        description=__doc__,
        examples=[
            "sb3-e2c completion bash > ~/.local/share/bash-completion/completions/sb3-e2c",
            "sb3-e2c completion zsh > ~/.sb3-e2c.zsh  # and in ~/.zshrc: source ~/.sb3-e2c.zsh",
        ],
    )
    parser.add_argument("shell", choices=_BEFORE, help="which shell")
    return parser


def script(shell: str, commands: Sequence[str]) -> str:
    """Lines for the shell to read.

    :param shell: "bash" or "zsh"
    :param commands: Names of the commands, each a module of the zoo
    """
    flags = [f'            {name}) words="{" ".join(flags_of(name))}" ;;' for name in commands]
    return _BEFORE[shell] + _SCRIPT.format(
        commands=" ".join(commands),
        algorithms=" ".join(ALGORITHMS),
        environments=" ".join(ENV_IDS),
        presets=" ".join(preset_names()),
        flags="\n".join(flags),
    )


def flags_of(command: str) -> list[str]:
    """The long flags in a command's help; RL-Zoo's parser shows them nowhere else.

    :param command: Its name
    """
    text = io.StringIO()
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(text):
        importlib.import_module(f"sb3_e2c.zoo.{command}").main(["--help"])
    lines = re.findall(r"^  (-.*)$", text.getvalue(), re.MULTILINE)
    return [flag for line in lines for flag in re.findall(r"(?<!\S)--[a-z][a-z-]+", line)]


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c completion``.

    :param argv: Arguments; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    print(script(args.shell, list(COMMANDS)))


if __name__ == "__main__":
    main()
