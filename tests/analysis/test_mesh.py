"""A mesh of a surface is closed, lies on it, and is refused where there is none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from surfaced import ball

import jaxsph as js
from jaxsph.analysis import mesh as meshes


def test_a_mesh_is_closed_welded_and_lies_on_the_surface_with_normals_out_of_it():
    particles = ball()
    two = dataclasses.replace(particles, position=np.asarray(particles.position) + np.float32([3.0, -7.0, 0.1]))
    scene = js.Scene(particles=two, surface=js.Surface(0.45, smoothing=1.2))
    made = js.mesh(scene)
    edges = made.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)  # each once in either direction
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    a, b, c = made.vertices[made.faces].swapaxes(0, 1)
    across = np.cross(b - a, c - a)
    assert ((across * made.normals[made.faces[:, 0]]).sum(1) > 0).mean() > 0.999
    support = 1.2 * float(np.median(np.asarray(particles.support)[np.asarray(particles.valid)]))
    middle = made.vertices - [3.0, -7.0, 0.1]
    volume = ((a - a.mean(0)) * across).sum() / 6
    assert abs(volume - 4 / 3 * np.pi * np.linalg.norm(middle, axis=1).mean() ** 3) < 0.05 * volume
    field = meshes.ParticleField(meshes.widened(scene).particle_set).at(made.vertices)
    assert np.median(np.abs(field.coverage - 0.45)) < 1e-3
    assert made.deviation[0] < 5e-3 * support and made.deviation[1] < 0.1 * support


def test_a_mesh_is_told_to_be_no_farther_from_its_surface_than_cells_allow():
    rng = np.random.default_rng(0)
    given = rng.uniform(0, 1, (40, 3)), rng.uniform(0.1, 0.4, 40), rng.normal(size=40), rng.uniform(0.5, 2, 40)
    made = js.mesh(js.Scene(particles=js.Particles.from_arrays(*given), surface=js.Surface()), cell=0.07)
    assert 0 < made.deviation[1] <= 2.25 * 0.07  # where the field is flat, its slope tells of distances that there are not


def test_a_surface_that_nothing_reaches_is_an_empty_mesh_and_what_is_none_is_refused(tmp_path):
    scene = js.Scene(particles=ball(), surface=js.Surface(9.0))
    made = js.mesh(scene)
    assert made.vertices.shape == made.faces.shape == (0, 3)
    for match, wrong in (
        ("cell` must be > 0", {"cell": -1.0}),
        ("cell` must be > 0", {"cell": 0}),
        ("more than", {"cell": 1e-4}),
    ):
        with pytest.raises(ValueError, match=match):
            js.mesh(scene, **wrong)
    with pytest.raises(ValueError, match="of a scene's surface"):
        js.mesh(js.Scene(particles=ball(), transfer=js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [1, 1])))
    with pytest.raises(ValueError, match=r"written as .obj or .ply"):
        made.save(tmp_path / "mesh.stl")
    made.save(tmp_path / "mesh.obj")
    assert (tmp_path / "mesh.obj").read_text() == ""
