"""The command line: ``warp-abtree info|build|query|clash|run|sweep|view|picture|bench``; see EXIT_STATUS."""

import argparse
import os
import signal
import sys
import warnings
from pathlib import Path

import warp as wp

from warp_abtree.app.cli import bench_command, clash_command, model_commands, query_command, run_command, sweep_command
from warp_abtree.app.cli.arguments import EXIT_STATUS, PROGRAM, Parser, PrintCompletion, shield_numbers
from warp_abtree.app.cli.progress import Progress, compile_notice, start_warp
from warp_abtree.app.pictures import command as picture_command
from warp_abtree.app.viewer import command as view_command
from warp_abtree.checks.kernel_loading import tell_loading
from warp_abtree.checks.package import __version__
from warp_abtree.checks.signals import handle_signals, not_swallowed


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = Parser(
        prog=PROGRAM,
        description="Mesh-mesh interference queries at any level of detail (LOD), in batches, on CUDA or the CPU.",
        epilog=f"examples:\n  {PROGRAM} info warp:bunny\n  {PROGRAM} run bunny_tori --picture out.png\n\n{EXIT_STATUS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    shells = ("bash", "zsh", "tcsh", "fish")
    parser.add_argument(
        "--print-completion", action=PrintCompletion, choices=shells, help="print the completion script of a shell"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)

    def command(name, function, summary, examples, add_arguments):
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog="examples:\n" + "\n".join(f"  {PROGRAM} {name} {example}".rstrip() for example in examples),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(function=function)
        sub.add_argument("--device", help='Warp device, "cpu" or "cuda:0"; by default the first GPU, else the CPU')
        sub.add_flag("--json", "print JSON")
        add_arguments(sub)

    models = model_commands
    command("info", models.info, models.INFO_SUMMARY, models.INFO_EXAMPLES, models.add_info_arguments)
    command("build", models.build, models.BUILD_SUMMARY, models.BUILD_EXAMPLES, models.add_build_arguments)
    for name, module, function in (
        ("query", query_command, query_command.query),
        ("clash", clash_command, clash_command.clash),
        ("run", run_command, run_command.run),
        ("view", view_command, view_command.run_viewer),
        ("picture", picture_command, picture_command.run_picture),
        ("sweep", sweep_command, sweep_command.run_sweep),
        ("bench", bench_command, None),
    ):
        command(name, function, module.SUMMARY, module.EXAMPLES, module.add_arguments)
    return parser


class Terminated(SystemExit):
    """SIGTERM: a command ends as after an interrupt, and removes half-written files."""


def terminate(number, frame):
    """Handle SIGTERM."""
    raise Terminated(128 + number)


def main(argv=None) -> int:
    """Run the command line, with arguments of its own or, for None, those of the process; return its exit status."""
    progress = Progress()
    try:
        if argv is None:
            handle_signals(not_swallowed(signal.default_int_handler), not_swallowed(terminate))
            warnings.formatwarning = lambda message, *_, **__: f"{PROGRAM}: {message}\n"
        argv = list(sys.argv[1:] if argv is None else argv)
        if argv[:1] == ["bench"] and argv[1:] not in (["-h"], ["--help"]):
            start_warp()
            return bench_command.bench(argv[1:])
        options, rest = make_parser().parse_known_args(shield_numbers(argv))
        if rest:
            raise ValueError(f"unrecognized arguments: {' '.join(rest)} (see {PROGRAM} {options.command} --help)")
        start_warp()
        tell_loading(progress.compiling if sys.stderr.isatty() else None)
        with compile_notice(progress=progress):
            status = options.function(options, progress) or 0
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader went away; Python must not complain once more when it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, MemoryError) as error:
        return _fail(progress, error, 2)
    except RuntimeError as error:  # work was lost, or the device failed
        return _fail(progress, error, 1)
    except KeyboardInterrupt:
        return _fail(progress, "interrupted", 130)
    except Terminated as error:
        return _fail(progress, "terminated", error.code)
    return status


def _fail(progress, error, status):
    progress.close()
    print(f"{PROGRAM}: {' '.join(str(error).split()) or type(error).__name__}{_cache_hint(error)}", file=sys.stderr)
    return status


def _cache_hint(error) -> str:
    """Return what to do about a kernel cache that cannot be written, or nothing."""
    if not isinstance(error, OSError) or error.filename is None or not wp.config.kernel_cache_dir:
        return ""
    cache, path = Path(wp.config.kernel_cache_dir), Path(os.fsdecode(error.filename))
    if cache not in (path, *path.parents) and (cache.exists() or path not in cache.parents):
        return ""
    return " (Warp's kernel cache; WARP_CACHE_PATH names a folder that can be written)"
