"""Programs that are kept whole are those of this package's own code, and what cannot be loaded is compiled."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from jaxsph.engine.cast import composite, march
from jaxsph.engine.cast.integrator import PointSamples
from jaxsph.engine.frame.stages import order
from jaxsph.engine.runtime import kept, store
from jaxsph.engine.runtime.programs import Programs, shapes_of, stage
from jaxsph.engine.runtime.tuning import CPU

THREE = jax.ShapeDtypeStruct((3,), np.float32)


class Theirs(PointSamples):
    """An integrator of another package."""


@pytest.fixture
def own_folder(monkeypatch):
    monkeypatch.setattr(store, "keep", lambda: True)
    monkeypatch.setattr(store, "is_chosen", lambda: False)
    monkeypatch.setattr(store, "_FIRST", {})  # so that the two patches above do not count as replaced


def test_a_program_is_known_by_all_that_it_is_made_from_and_by_this_package_s_code_alone(own_folder, monkeypatch):
    def known(function=order, arguments=(THREE,), settings=(False, None), **static):
        return store.known_by(function, arguments, static, settings)

    names = [
        known(tuning=CPU, method=PointSamples()),
        known(tuning=dataclasses.replace(CPU, turns=8), method=PointSamples()),
        known(tuning=CPU),
        known(tuning=CPU, method=PointSamples(), settings=(True, None)),
        known(tuning=CPU, method=PointSamples(), arguments=(jax.ShapeDtypeStruct((3,), np.float64),)),
        known(tuning=CPU, method=PointSamples(), arguments=[THREE]),
        known(function=stage()(kept.folder), tuning=CPU, method=PointSamples()),
    ]
    assert len(set(names)) == len(names) and None not in names
    assert known(tuning=dataclasses.replace(CPU), method=PointSamples()) == names[0]
    assert known(method=Theirs()) is None and known(method=lambda: 0) is None and known(function=stage()(np.zeros)) is None
    assert known(arguments=(np.ones(3),)) is None, "of values nothing is known"
    for place, name in ((composite, "composite"), (PointSamples, "segment"), (march, "TWICE")):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, None)
            assert known(tuning=CPU, method=PointSamples()) is None, "what was replaced here is not for other processes"
    assert known(tuning=CPU, method=PointSamples()) == names[0]


def test_what_cannot_be_loaded_is_compiled(monkeypatch):
    monkeypatch.setattr(store, "known_by", lambda *_: "halved")
    monkeypatch.setattr(store, "found", lambda name, shapes: (shapes[0], lambda: None))
    programs, ones = Programs(), np.ones(3, np.float32)
    assert programs.get(stage()(lambda value: value / 2), shapes_of((ones,)), {})(ones).tolist() == [0.5] * 3
