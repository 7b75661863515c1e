"""Options by which a command has its frames rendered by several processes, or by a cluster.

Flow: --workers N, --client ADDRESS -> [cli_cluster] -> distributed.Client -> render_frames.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from typing import Any

from jaxsph.cli.console import UsageError, say
from jaxsph.io.libraries import require

ANSWER = 30.0
"""Seconds within which a scheduler must answer."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Those of the command `movie`."""
    add = parser.add_argument_group("several processes").add_mutually_exclusive_group().add_argument
    add("--workers", type=int, metavar="N", help="render frames by N processes of this machine, each with its share of the cores")
    add("--client", metavar="ADDRESS", help="render frames by the workers of a Dask scheduler, such as tcp://HOST:8786")


def check(options: argparse.Namespace) -> None:
    """Refuse numbers that make no sense."""
    if options.workers is not None and options.workers < 1:
        raise UsageError(f"--workers must be at least 1, got {options.workers}")


@contextlib.contextmanager
def client_of(options: argparse.Namespace) -> Iterator[Any]:
    """The client that is asked for, until the block ends; None where frames are rendered by this process.

    Raises:
        ImportError: distributed is not installed.
        UsageError: no address.
        RuntimeError: a scheduler that does not answer.
    """
    if options.workers is None and options.client is None:
        yield None
        return
    require("distributed", "frames on several processes", "cluster")
    if options.workers is not None:
        from jaxsph.sequence.workers import local_client

        with local_client(options.workers) as client:
            say("workers", f"{options.workers} processes of this machine")
            yield client
        return
    with _connected(options.client) as client:
        number = len(client.nthreads())
        say("cluster", f"{options.client}, {number} workers" if number else f"{options.client}; waiting for its first worker")
        yield client


def _connected(address: str) -> Any:
    distributed = require("distributed", "frames on a cluster", "cluster")
    try:
        return distributed.Client(address, timeout=ANSWER, name="jaxsph")
    except (TimeoutError, OSError) as error:
        raise RuntimeError(
            f"--client {address}: no scheduler answers there within {ANSWER:g} s; start one by `dask scheduler`, "
            "or take --workers N for processes of this machine"
        ) from error
    except ValueError as error:
        raise UsageError(f"--client {address} is no address of a scheduler, such as tcp://HOST:8786 ({error})") from error
