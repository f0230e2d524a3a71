"""The ``velfield`` command. Imports nothing heavy until a command runs."""

import atexit
import errno
import gc
import os
import sys
import warnings
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from cyclopts import App, Argument, CycloptsError, MissingArgumentError

from flows.launch import limit_threads, use_writable_folders
from flows.options import BAD_INPUT, DONE, USAGE
from flows.stopping import STOPPED, as_ctrl_c, leave
from velfield.errors import (
    CacheWarning,
    DeviceWarning,
    IneffectiveSettingWarning,
    InputError,
    StoreError,
)


def _version() -> str:
    from velfield.run.commits import code_version

    return code_version()


app = App(
    name="velfield",
    help="Aerial video of a city in, a probability distribution over vehicle velocity at every pixel of the map out.",
    version=_version,
    version_flags=["--version"],
    help_format="plaintext",  # Markdown takes a third of the time of --help
    suppress_keyboard_interrupt=False,  # it would end without a message, and leave child processes behind
)

# Each in a file of its own, imported when it runs.
app.command("flows.commands.run:run", name="run", help="Compute a velocity field from aerial video.")
app.command("flows.commands.simulate:simulate", name="simulate", help="Simulate a flight over a city, with truth.")
app.command("flows.commands.demo:demo", name="demo", help="Simulate a drone clip, run the whole job, and score it.")
app.command("flows.commands.init:init", name="init", help="Inspect a video and write a commented flight.yaml.")
app.command("flows.commands.config:config", name="config", help="Print the configuration of a run.")
app.command("flows.commands.view:view", name="view", help="Show a run's page in the browser.")
app.command("flows.commands.analyse:analyse", name="analyse", help="Lanes, turning counts, speeds, signals: a report.")
app.command("flows.commands.annotate:annotate", name="annotate", help="Label cars in the browser, as training data.")
app.command("flows.commands.train:train", name="train", help="Train a detector from labelled cars.")
app.command("flows.commands.export:export", name="export", help="Write a finished run in another format.")
app.command("flows.commands.lineage:lineage", name="lineage", help="Print the lineage of a run, or of a pixel.")
app.command("flows.commands.reprocess:reprocess", name="reprocess", help="Put a new base image under a finished run.")
app.command(
    "flows.commands.georeference:georeference", name="georeference", help="Georeference a run by control points."
)
app.command("flows.commands.serve:serve", name="serve", help="Process flights that arrive in a folder, with a UI.")
app.command("flows.commands.verify:verify", name="verify", help="Check the integrity of a run folder, or repair it.")
app.command("flows.commands.algebra:merge", name="merge", help="Add the fields of runs that share a grid, exactly.")
app.command("flows.commands.algebra:subtract", name="subtract", help="Subtract a field from a merged one, exactly.")
app.command("flows.commands.algebra:compare", name="compare", help="Map what changed between two fields.")
app.command("flows.commands.bench:bench", name="bench", help="Measure speed and accuracy against other programs.")


@app.command
def schema() -> int:
    """Print the JSON Schema of flight.yaml, for editors."""
    import json

    from schemas.flight import FlightConfig

    print(json.dumps(FlightConfig.model_json_schema(), indent=1))
    return DONE


def _warn_of_settings_in_one_line() -> None:
    show = warnings.showwarning

    def showwarning(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if issubclass(category, CacheWarning | IneffectiveSettingWarning | DeviceWarning):
            print(f"velfield: {message}", file=sys.stderr)
        else:
            show(message, category, *where, **options)

    warnings.showwarning = showwarning


def _start() -> int:
    from flows.commands.start import start

    return start(Path.cwd())


def _choices(argument: Argument | None) -> str:
    """Allowed values of an option, in parentheses; empty if it is not one of a set of words."""
    words = get_args(argument.hint) if argument is not None and get_origin(argument.hint) is Literal else ()
    return f" (one of {', '.join(words)})" if words else ""


def _explain_s3(error: Exception) -> str:
    if type(error).__name__ == "NoCredentialsError":
        return (
            "no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile (AWS_PROFILE), or give this "
            "machine a role"
        )
    return " ".join(str(error).split())  # no such server, an address that is none


def main() -> None:
    """Run the command; bad input is one clear line, never a traceback."""
    limit_threads()
    as_ctrl_c()
    atexit.register(gc.freeze)  # what is left goes with the process: to look through it takes a second
    _warn_of_settings_in_one_line()
    try:
        if not {"--help", "-h", "--version"} & set(sys.argv):
            use_writable_folders()
        options: dict[str, Any] = {"result_action": "return_value", "exit_on_error": False, "print_error": False}
        status = _start() if len(sys.argv) == 1 else app(sys.argv[1:], **options)
    except MissingArgumentError as error:
        chain, missing = " ".join(error.command_chain or ()), error.keyword
        name = f"value for {missing}" if missing else getattr(error.argument, "name", "")
        choices = "" if missing else _choices(error.argument)
        print(f"velfield: {chain}: {name} is missing{choices}; see `velfield {chain} --help`", file=sys.stderr)
        status = USAGE
    except CycloptsError as error:  # the library's own message is a box of several lines
        print(f"velfield: {' '.join(str(error).split())} `velfield COMMAND --help` lists all", file=sys.stderr)
        status = USAGE
    except InputError as error:
        print(f"velfield: {error}", file=sys.stderr)
        status = BAD_INPUT
    except (BrokenPipeError, SystemExit) as error:  # the reader of our output has closed it: rich, of --help, exits
        if not isinstance(error, BrokenPipeError) and not isinstance(error.__context__, BrokenPipeError):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = DONE
    except (StoreError, OSError) as error:  # a damaged run; a disk that is full, read-only or gone
        print(f"velfield: {' '.join(_explain(error).split())}", file=sys.stderr)
        status = BAD_INPUT
    except KeyboardInterrupt:
        leave(STOPPED)
    except Exception as error:
        if type(error).__module__.split(".")[0] not in ("botocore", "aiobotocore"):
            raise
        print(f"velfield: S3: {_explain_s3(error)}", file=sys.stderr)
        status = BAD_INPUT
    sys.exit(status)


_REFUSALS = (errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.ENOTDIR)


def _explain(error: Exception) -> str:
    """What a disk refused, by the name of the file alone."""
    if not isinstance(error, OSError) or error.filename is None or error.errno not in _REFUSALS:
        return str(error)
    return f"{error.filename}: {error.strerror}; expected a place that is there, has room, and can be read and written"


if __name__ == "__main__":
    main()
