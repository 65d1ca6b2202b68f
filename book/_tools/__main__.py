"""Run the notebooks and build the book: the commands behind the Makefile."""

import os
import signal
import sys
from pathlib import Path

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
    # The imports below take a second, and there is nothing to remove yet: Ctrl-C needs no traceback.
    signal.signal(signal.SIGINT, lambda *_: (os.write(2, b"interrupted\n"), os._exit(1)))

from .environment import enter_clean

if __name__ == "__main__":
    enter_clean()

from .project import Project, ToolError, one_line
from .scratch import end_cleanly_on_signals, one_at_a_time, remove_abandoned

ROOT = Path(__file__).resolve().parents[2]
USAGE = """usage: python -m book._tools COMMAND

  book      run the notebooks that changed and build the book
  figures   replace the committed notebooks and the front figure by freshly run ones
  rerun     run one notebook with other parameters: rerun --help lists the options"""


def main(arguments: list[str], project: Project | None = None) -> int:
    """Run a command; return the exit status of the process."""
    command, *options = arguments or [""]
    project = project or Project(ROOT)
    try:
        # Each command imports what it needs: the packages behind the others take seconds.
        if command == "rerun":
            from .rerun import rerun

            end_cleanly_on_signals()
            rerun(project, options)
        elif command in ("book", "figures") and not options:
            from . import book

            end_cleanly_on_signals()
            with one_at_a_time(project.build):
                remove_abandoned(project.build)
                getattr(book, command)(project)
        else:
            print(USAGE, file=sys.stderr)
            return 2
    except ToolError as failure:
        print(f"{command}: {failure}", file=sys.stderr)
        return failure.status
    except OSError as error:  # a full disk, a locked folder, a name that is too long
        print(f"{command}: {one_line(str(error))}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted: unfinished results were removed", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
