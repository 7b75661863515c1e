"""How many examples Hypothesis tries: a test's own number, times that of the profile."""

from __future__ import annotations

import os

import hypothesis

EXAMPLES = 40  # where a test names no number, in the profiles `dev` and `ci`
USUAL = "ci" if os.environ.get("CI") else "dev"  # profile


def examples(count: int, **more) -> hypothesis.settings:
    """`@examples(15)`: fifteen examples, and 150 of them at night."""
    return hypothesis.settings(max_examples=max(1, count * hypothesis.settings().max_examples // EXAMPLES), **more)
