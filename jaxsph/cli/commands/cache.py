"""The command `cache`: where compiled programs are kept, and how large they are.

Flow: cache -> [cache] -> lines on stdout.
"""

from __future__ import annotations

from jaxsph.cli import cache as kept
from jaxsph.cli import voice
from jaxsph.cli.options import groups

OPTIONS = groups.Options()


def cache(*, asked: groups.Options = OPTIONS) -> None:
    """Say where compiled programs are kept, and how large they are."""
    kept.say_kept()
    voice.report(folder=str(kept.folder()))
