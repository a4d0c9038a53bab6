"""`check`: what a support request needs to know about this machine."""

from __future__ import annotations

import argparse
import json

from ..runs import system_findings

DESCRIPTION = """\
Report the versions of Python and of the packages, the devices with their memory, the CPU's features, memory, disk,
whether VTK can render with no display, and which network weights are found. Send the output with a support request.
Exit code 0 when everything needed is there, 1 otherwise."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = DESCRIPTION
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args, _progress) -> int:
    report = system_findings.make_report()
    if args.json:
        print(json.dumps(report, indent=1))
    else:
        print("\n".join(system_findings.report_lines(report)))
    return 1 if report["problems"] else 0
