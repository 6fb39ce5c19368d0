"""The command line `mrac-jax`. Heavy imports happen inside the commands, so that `--help` is quick.

Results go to standard output, progress and notes to standard error. Exit status: 0 done; 1 a check failed; 2 bad input
or usage, one line on standard error beginning `error:`; 130 interrupted.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cyclopts import App, CycloptsError, Group, MissingArgumentError, UnknownOptionError

from analysis.cli import answers, missions, research  # noqa: F401 (which make the commands)
from analysis.cli.console import BAD_INPUT, COMMAND, DONE, INTERRUPTED, check_streams, output_console
from analysis.cli.options import COMMANDS, group_of
from analysis.utils.notes import elsewhere, say
from planner.arguments import COMMAND_LINE
from planner.errors import PER_VISIT, RENAMED, InputError, RenamedWarning, warn_renamed

ALL, NO_CACHE_OPTION = "--help-all", "--no-cache"
"""Options of every command, handled before the command runs."""


def make_app(everything: bool) -> App:
    """The command line; `everything`: its help also lists the rare options."""
    made = App(
        name="mrac-jax",
        help="How much of a dangerous area will a team of robots cover before it is lost, and how sure are we?",
        help_epilogue=f"{ALL} lists every option. With {NO_CACHE_OPTION}, compiled code is not kept on disk.",
        help_flags=("--help", "-h", ALL),
        group_commands=Group("Commands", sort_key=len(COMMANDS)),
        version=lambda: version("mrac-jax"),
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    sections = list(dict.fromkeys(one.section for one in COMMANDS))
    for place, one in enumerate(COMMANDS):  # in the order in which they are defined
        heading = group_of(one.section, sections.index(one.section))
        made.command(one.bound(everything), name=one.name, group=heading, sort_key=place)
    return made


app = make_app(True)


LEFT = {
    "graph": "orienteering on graphs left with release 0.4; use release 0.3",
    "suite": "is now `python -m mrac_jax.env.suite`",
    "reproduce policies": "is now docs/examples/experiments.py policies",
    "reproduce online": "is now docs/examples/experiments.py online",
    "reproduce moving": "is now docs/examples/experiments.py moving",
    "--metrics": "left with release 0.4; docs/value.md has the figures of every field",
    **dict.fromkeys(("--luck", "--mode"), PER_VISIT),
}
"""Commands and options of older releases that were removed, and their replacements."""


def _as_threats(words: list[str], action: str) -> list[str]:
    """`clear --count 2 --remove areas` as `threats --remove 2 --unit areas`, `attack` likewise with --add."""
    spelt = [word.replace("--remove", "--unit").replace("--count", action) for word in words]
    return ["threats", *spelt, *([] if any(word.startswith(action) for word in spelt) else [action])]


def _as_repair(words: list[str]) -> list[str]:
    """`recover FILE --out OUT` as `inspect FILE --repair OUT`; OUT is NAME.recovered.mcap by default."""
    spelt = [word.replace("--out", "--repair") for word in words]
    if any(word.startswith("--repair") for word in spelt):
        return ["inspect", *spelt]
    name = next((word for word in words if not word.startswith("-")), "")
    return ["inspect", *spelt, "--repair", f"{name.removesuffix('.partial').removesuffix('.mcap')}.recovered.mcap"]


RENAMED_COMMANDS: dict[str, tuple[str, Callable[[list[str]], list[str]]]] = {
    "clear": ("threats --remove", lambda words: _as_threats(words, "--remove")),
    "attack": ("threats --add", lambda words: _as_threats(words, "--add")),
    "replay": ("inspect --replay", lambda words: ["inspect", *words, "--replay"]),
    "recover": ("inspect --repair", _as_repair),
    "reproduce": ("check --paper", lambda words: ["check", "--paper", *words]),
}
"""Commands of release 0.3: the new command, and the function that converts the words after it."""


def _new_command(words: list[str]) -> list[str]:
    """The words with today's command, after one line that names it; `--remove` and `--add` alone mean 1."""
    old = words[0] if words else ""
    if old in RENAMED_COMMANDS and not {"--help", "-h", ALL} & set(words):
        new, rewrite = RENAMED_COMMANDS[old]
        warn_renamed(f"`{old}`", f"`{new}`")
        words = rewrite(words[1:])
    elif old in RENAMED_COMMANDS:
        words = [RENAMED_COMMANDS[old][0].split()[0], *words[1:]]
    if words[:1] != ["threats"]:
        return words
    return [
        one
        for word, after in zip(words, [*words[1:], "-"], strict=True)
        for one in ([word, "1"] if word in ("--remove", "--add") and not after.isdigit() else [word])
    ]


def _missing(error: MissingArgumentError) -> str:
    """Text of a missing argument: an input, or the value of an option."""
    name, command = error.argument.name if error.argument else "", " ".join(error.command_chain or ("mrac-jax",))
    wanted = {"INPUT": "an INPUT, e.g. example:paper", "A": "A, an INPUT, e.g. example:paper"}.get(name, name)
    return f"{command} needs {wanted if name.isupper() else f'a value after {error.keyword or name}'}"


def _unknown(error: UnknownOptionError) -> str:
    """The message for an unknown option, with the closest option of this or another command."""
    given, command = (error.token.keyword or error.token.value).split("=")[0], " ".join(error.command_chain or ())
    if given in LEFT:
        return f"{given}: {LEFT[given]}"
    options = {
        name: [one for argument in app[name].assemble_argument_collection() for one in argument.names if one[:1] == "-"]
        for name in (one.name for one in COMMANDS)
    }
    own = options.pop(command, [])
    fix = elsewhere(given, own, options, "option") or f"`mrac-jax {command} --help` lists its options"
    return f"Unknown option: {given}; {fix}"


def _new_option(word: str) -> str:
    """A word of the command line; an option of release 0.3 gets today's name, after one line that names it."""
    name, *value = word.split("=", 1)
    start, last = ("--b.", name[4:]) if name.startswith("--b.") else ("--", name[2:])
    new = RENAMED.get(last.replace("-", "_")) if name.startswith("--") else None
    if new is None or last in ("truth", "prior", "movers", "hazard", "uncertain"):
        return word
    option = start + new.replace("_", "-")
    warn_renamed(name, option)
    return "=".join([option, *value])


def run(arguments: Sequence[str] | None = None, other: App | None = None) -> int:
    """Run one command line, of `mrac-jax` or of an `other` program; returns the exit status.

    A name of release 0.3 is one line on standard error.
    """
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show_warning(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, RenamedWarning):
                say([f"note: {message}"])
            else:
                usual(message, category, *where, **more)

        warnings.showwarning = show_warning
        warnings.simplefilter("default", RenamedWarning)
        return _run(arguments, other)


def _run(arguments: Sequence[str] | None, other: App | None) -> int:
    words = list(sys.argv[1:] if arguments is None else arguments)
    if NO_CACHE_OPTION in words:
        words = [word for word in words if word != NO_CACHE_OPTION]
        from planner.simulator.jit import NO_CACHE

        os.environ[NO_CACHE] = "1"
    for old in (name for name in (" ".join(words[:1]), " ".join(words[:2])) if name in LEFT and other is None):
        say([f"error: {old}: {LEFT[old]}"])
        return BAD_INPUT
    words = [_new_option(word) for word in _new_command(words)]
    command_token, named = COMMAND.set(tuple(words)), COMMAND_LINE.set(True)
    try:
        check_streams()
        asked = other or (app if ALL in words or not {"--help", "-h"} & set(words) else make_app(False))
        status: Any = asked(words, exit_on_error=False, print_error=False, console=output_console())
        return status if isinstance(status, int) else DONE
    except MissingArgumentError as error:
        line = _missing(error)
    except UnknownOptionError as error:
        line = _unknown(error)
    except CycloptsError as error:  # it wraps the InputError of an option's converter, a ValueError
        line = " ".join(str(error.__cause__ if isinstance(error.__cause__, InputError) else error).split())
    except InputError as error:
        line = str(error)
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115
        return DONE
    except KeyboardInterrupt:
        say(["interrupted"])
        return INTERRUPTED
    except MemoryError:
        line = "out of memory; expected a map that fits; coarsen it with cell_size"
    except OSError as error:
        line = f"{error.filename or 'output'}: {error.strerror}; expected a file or folder that can be used"
    finally:
        COMMAND.reset(command_token)
        COMMAND_LINE.reset(named)
    say([f"error: {line}"])
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(run())
