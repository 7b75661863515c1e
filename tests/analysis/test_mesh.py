"""A mesh of a surface is closed, lies on it, and is refused where there is none."""

from __future__ import annotations

import dataclasses

import jax
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


@pytest.mark.parametrize(("offset", "scale"), [(3e8, 1.0), (0.0, 1e-12), (1e12, 1e6)])
@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_vertices_far_away_are_written_whole(tmp_path, offset, scale, suffix):
    rng = np.random.default_rng(1)
    place = offset + scale * rng.uniform(0, 2, (60, 3))
    quantity = 1e8 + rng.uniform(0, 1, 60)
    with jax.enable_x64(True):
        particles = js.Particles.from_arrays(place, 0.6 * scale, quantity, scale**3 * 8 / 60)
        made = js.mesh(js.Scene(particles=particles, surface=js.Surface()))
    made.save(tmp_path / f"m.{suffix}")
    if suffix == "ply":
        table = js.io.read_table(tmp_path / "m.ply")
        np.testing.assert_array_equal(table.columns["quantity"], made.quantity)
        read = table.position
    else:
        lines = (tmp_path / "m.obj").read_text().splitlines()
        read = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    assert len(made.vertices) > 100
    np.testing.assert_array_equal(read, made.vertices)


def test_cells_wider_than_supports_and_empty_meshes_are_told():
    with pytest.warns(UserWarning, match=r"cells of 5 are wider than supports.*is lost; `cell="):
        js.mesh(js.Scene(particles=ball(), surface=js.Surface()), cell=5.0)
    with pytest.warns(UserWarning, match="mesh is empty: the surface is at 9, and the field reaches .*lower level"):
        js.mesh(js.Scene(particles=ball(), surface=js.Surface(9.0)))


def test_bodies_far_apart_are_meshed_as_each_alone(monkeypatch):
    rng = np.random.default_rng(2)
    one, shift = rng.uniform(0, 1, (50, 3)), np.array([400.0, 300, 500])
    whole = js.Particles.from_arrays(np.concatenate([one, one + shift]), 0.4, 0.0, 1 / 50)
    alone = js.Particles.from_arrays(one, 0.4, 0.0, 1 / 50)
    made, single = (js.mesh(js.Scene(particles=p, surface=js.Surface()), cell=0.1) for p in (whole, alone))
    near = made.vertices[:, 0] < 100
    np.testing.assert_allclose(made.vertices[near], single.vertices, atol=1e-5)  # positions far away are rounded
    assert abs(len(made.faces) / len(single.faces) - 2) < 0.1


def test_small_pieces_of_a_surface_are_left_out():
    rng = np.random.default_rng(3)
    place = np.concatenate([rng.uniform(0, 1, (200, 3)), [[3.0, 3, 3], [5, 0, 0]]])
    scene = js.Scene(particles=js.Particles.from_arrays(place, 0.4, 0.0, 0.05), surface=js.Surface())
    every, some = js.mesh(scene), js.mesh(scene, smallest_piece=0.1)
    assert every.vertices.max() > 2.9 and some.vertices.max() < 2
    assert 0 < len(some.faces) < len(every.faces) and some.faces.max() == len(some.vertices) - 1
    with pytest.raises(ValueError, match=r"smallest_piece` must lie in \[0, 1\], got 2"):
        js.mesh(scene, smallest_piece=2)
