"""The option --devices: what one picture is shared among.

Flow: [cli_devices] -> cli.
"""

from __future__ import annotations

import argparse

from jaxsph.cli.console import UsageError
from jaxsph.engine.runtime.devices import chosen_devices


def add_options(parser: argparse.ArgumentParser) -> None:
    """The option of devices."""
    add = parser.add_argument_group("devices").add_argument
    add("--devices", type=_devices, metavar="all|N", help="share the picture among devices: all, or so many (default: one)")


def devices_of(options: argparse.Namespace) -> str | int | None:
    """What was asked for, if this machine has it."""
    wanted: str | int | None = options.devices
    if wanted is None:
        return None
    if options.progressive:
        raise UsageError("--devices is not for --progressive, whose stages go by one device; leave out one of them")
    try:
        chosen_devices(wanted)
    except ValueError as error:
        raise UsageError(f"--devices: {error}") from error
    return wanted


def _devices(text: str) -> str | int:
    if text == "all":
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither `all` nor a number of devices") from None
