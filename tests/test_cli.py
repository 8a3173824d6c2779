"""``sb3-e2c``: help, suggestions and completion of every command."""

import importlib
import os
import re
import shlex
import subprocess
import sys
from argparse import Namespace

import pytest

import sb3_e2c

pytest.importorskip("rl_zoo3")

from sb3_e2c.zoo import cli, completion, train
from sb3_e2c.zoo.console import ConsoleParser


class Parsed(Exception):
    """``train`` has read its flags."""


def help_of(capsys, command):
    with pytest.raises(SystemExit) as exit_:
        cli.main([command, "--help"])
    assert exit_.value.code == 0
    return capsys.readouterr().out


def error_of(capsys, *argv):
    with pytest.raises(SystemExit) as exit_:
        cli.main(list(argv))
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines(keepends=True)
    return line


def parse(command, flags, monkeypatch):
    """Have a command read its flags, and do nothing."""
    if command != "train":
        return importlib.import_module(f"sb3_e2c.zoo.{command}").make_parser().parse_args(flags)

    def stop(_):
        raise Parsed

    monkeypatch.setattr(train, "_check", stop)
    for lookup in ("resumed_arguments", "trial_arguments"):  # of runs that do not exist here
        monkeypatch.setattr(train, lookup, lambda *_: Namespace(), raising=False)
    with pytest.raises(Parsed):
        train.main(flags)
    return None


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_has_an_example_whose_flags_parse(capsys, monkeypatch, command):
    lines = [line.strip() for line in help_of(capsys, command).splitlines()]
    examples = [shlex.split(line, comments=True) for line in lines if line.startswith("sb3-e2c ")]
    assert any(words[1] == command for words in examples)
    for _, name, *flags in examples:
        flags = flags[: flags.index(">")] if ">" in flags else flags
        parse(name, flags, monkeypatch)


def test_help_lists_every_command(capsys):
    cli.main(["--help"])
    shown = re.findall(r"^  (\w+) +\w", capsys.readouterr().out, re.MULTILINE)
    assert shown == list(cli.COMMANDS)


def test_no_command_shows_the_help(capsys):
    cli.main([])
    assert capsys.readouterr().out.startswith("usage: sb3-e2c COMMAND [FLAGS]")


@pytest.mark.parametrize(
    ("argv", "nearest"),
    [
        (["enjoy", "--algoo", "e2c"], "arguments: --algoo e2c; did you mean --algo?"),
        (["enjoy", "--algoo=e2c"], "arguments: --algoo=e2c; did you mean --algo?"),
        (["train", "--n-timestep5", "8"], "did you mean --n-timesteps?"),
        (["push", "--repo_id", "me/team"], "did you mean --repo-id?"),
        (["load", "--repo-id", "me/team", "--revison", "a"], "did you mean --revision?"),
        (["enjoy", "extra"], "unrecognized arguments: extra\n"),
        (["enjoy", "--zzz"], "unrecognized arguments: --zzz\n"),
        (["train", "--preset", "pur"], "unknown preset (--preset) 'pur'; did you mean 'pure'?"),
        (["benchmark", "--suite", "smok"], "did you mean 'smoke'?"),
        (["pusk"], "unknown command 'pusk'; did you mean 'push'?"),
    ],
)
def test_what_is_unknown_gets_the_nearest_name(capsys, tmp_path, monkeypatch, argv, nearest):
    monkeypatch.chdir(tmp_path)
    assert nearest in error_of(capsys, *argv)


def test_a_parser_without_examples_has_no_heading_for_them():
    assert "examples" not in ConsoleParser(prog="a").format_help()
    assert ConsoleParser(examples=["a -b", "c"]).format_help().endswith("examples:\n  a -b\n  c\n")


# ---------------------------------------------------------------------------- completion


@pytest.fixture(scope="module")
def bash_script():
    return completion.script("bash", ["train", "load"])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["sb3-e2c", "lo"], ["load"]),
        (["sb3-e2c", "load", "--re"], ["--repo-id", "--revision"]),
        (["sb3-e2c", "train", "--wandb-pr"], ["--wandb-project-name"]),
        (["sb3-e2c", "train", "--n-tr"], []),  # RL-Zoo's, refused by train
        (["sb3-e2c", "train", "--algo", "e2"], ["e2c", "e2c_t"]),
        (["sb3-e2c", "train", "--env", "Keep"], ["KeepAway-v0"]),
        (["sb3-e2c", "train", "--preset", "lam"], ["lambda_1"]),
    ],
)
@pytest.mark.skipif(not os.path.exists("/bin/bash"), reason="needs bash")
def test_bash_completes(bash_script, words, expected):
    line = " ".join(map(shlex.quote, words))
    tail = f"COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _sb3_e2c; echo ${{COMPREPLY[@]}}"
    command = ["/bin/bash", "-c", f"{bash_script}\n{tail}"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert shown.stderr == ""
    assert shown.stdout.split() == expected


def test_zsh_takes_the_same_script_after_a_preamble(bash_script):
    script = completion.script("zsh", ["train", "load"])
    assert "bashcompinit" in script
    assert script.endswith(bash_script)


def test_completion_knows_every_command(capsys):
    cli.main(["completion", "bash"])
    assert f'1:*) words="{" ".join(cli.COMMANDS)}"' in capsys.readouterr().out


def test_help_needs_no_torch():
    code = "import sys; from sb3_e2c.zoo import cli; cli.main([]); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_ctrl_c_while_a_command_is_imported_is_one_line(monkeypatch, capsys):
    def interrupted(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.importlib, "import_module", interrupted)
    with pytest.raises(SystemExit) as exit_:
        cli.main(["plot"])
    assert exit_.value.code == 130
    assert capsys.readouterr().err == "sb3-e2c: interrupted\n"


def test_every_public_name_is_found():
    for name in sb3_e2c.__all__:
        assert getattr(sb3_e2c, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = sb3_e2c.nothing
