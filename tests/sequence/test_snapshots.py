"""Sequences of snapshots: one look, particles at any time, and files that cannot be part of one."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.sequence import Snapshots


def write(folder, number, *, ids=True, time=True, seed=0, count=200, shift=0.0, dtype=np.float32, **more):
    rng = np.random.default_rng(seed)
    position = (rng.normal(size=(count, 3)) + (shift, 0, 0)).astype(dtype)
    columns = {"temperature": np.linspace(0, 1 + number, count), "support": np.full(count, 0.5)}
    columns |= {"id": np.arange(count)} if ids else {}
    columns |= {"time": 0.5 * number} if time else {}
    path = folder / f"s_{number:02d}.npz"
    np.savez(path, position=position, **(columns | more))
    return path


def test_between_two_files_particles_are_on_their_way(tmp_path):
    snapshots = Snapshots.from_files([write(tmp_path, 0), write(tmp_path, 1, shift=4.0)])
    for share in (0.0, 0.25, 1.0):
        found = snapshots.at(0.5 * share).particles
        expected = np.random.default_rng(0).normal(size=(200, 3)) + (4 * share, 0, 0)
        np.testing.assert_allclose(found.to_numpy()["position"], expected, atol=1e-5)
    assert snapshots.times == (0.0, 0.5)
    assert "straight and evenly in 1" in snapshots.survey.told()[1]
    assert "8 supports" in snapshots.survey.told()[2]


def test_velocities_that_lead_there_bend_the_way(tmp_path):
    fall = np.zeros((200, 3))
    fall[:, 0] = 1
    paths = [write(tmp_path, 0, velocity=0 * fall), write(tmp_path, 1, shift=1.0, velocity=4 * fall)]
    snapshots = Snapshots.from_files(paths)
    found = snapshots.at(0.25).particles.to_numpy()["position"] - np.random.default_rng(0).normal(size=(200, 3))
    np.testing.assert_allclose(found[:, 0], 0.25, atol=1e-5)  # a quarter of the way in half of the time
    assert "by their velocities in 1" in snapshots.survey.told()[1]


def test_without_ids_it_is_the_nearer_file_and_that_is_said(tmp_path):
    snapshots = Snapshots.from_files([write(tmp_path, 0), write(tmp_path, 1, ids=False, shift=4.0)])
    for time, shift in ((0.24, 0), (0.26, 4)):
        expected = np.random.default_rng(0).normal(size=(200, 3)) + (shift, 0, 0)
        np.testing.assert_allclose(snapshots.at(time).particles.to_numpy()["position"], expected, atol=1e-5)
    assert snapshots.survey.told() == ["1 of 1 intervals show the nearer snapshot, as particles have no ids"]


def test_colours_span_nearly_all_values_of_all_files_and_stay(tmp_path):
    snapshots = Snapshots.from_files([write(tmp_path, number, count=400) for number in range(3)])
    low, high = np.percentile(np.concatenate([np.linspace(0, 1 + number, 400) for number in range(3)]), (0.5, 99.5))
    assert snapshots.survey.span == pytest.approx((low, high))
    looks = [snapshots.at(time).transfer for time in (0, 0.3, 1)]
    assert all(look is looks[0] for look in looks)


def test_all_moments_have_arrays_of_one_size_and_structure(tmp_path):
    paths = [write(tmp_path, 0, count=150), write(tmp_path, 1, count=600), write(tmp_path, 2, count=300, dtype=np.float64)]
    snapshots = Snapshots.from_files(paths)
    found = [snapshots.at(time).particles for time in (0, 0.2, 0.5, 0.9, 1)]
    assert {one.capacity for one in found} == {snapshots.capacity}
    assert [one.num_particles for one in found] == [150, 150, 600, 300, 300]
    assert len({one.position_rest is None for one in found}) == 1


def test_bounds_hold_all_particles_of_all_files(tmp_path):
    paths = [write(tmp_path, 0), write(tmp_path, 1, shift=9.0)]
    lower, upper = Snapshots.from_files(paths).bounds()
    position = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    np.testing.assert_allclose(lower, position.min(0) - 0.5, rtol=1e-6)
    np.testing.assert_allclose(upper, position.max(0) + (9.5, 0.5, 0.5), rtol=1e-5)


def test_a_density_that_is_summed_can_be_shown(tmp_path):
    snapshots = Snapshots.from_files([write(tmp_path, number, count=80) for number in range(2)], "density")
    assert snapshots.survey.quantity == "density" and snapshots.survey.span[1] > 0


def test_a_file_may_hold_no_particles(tmp_path):
    paths = [write(tmp_path, 0), write(tmp_path, 1, count=0)]
    assert len(Snapshots.from_files(paths, support="2*support").times) == 2


def test_all_files_that_are_cut_short_are_named(tmp_path):
    paths = [write(tmp_path, number) for number in range(6)]
    for number in (1, 3):  # the one in the middle is among them
        paths[number].write_bytes(paths[number].read_bytes()[:900])
    with pytest.raises(ValueError, match="2 of 6 snapshots cannot be read") as error:
        Snapshots.from_files(paths)
    assert all(str(paths[number]) in str(error.value) for number in (1, 3)) and str(paths[0]) not in str(error.value)


def test_where_files_may_be_unreadable_times_beside_them_have_no_scene_and_all_others_are_as_before(tmp_path):
    paths = [write(tmp_path, number) for number in range(6)]
    whole = Snapshots.from_files(paths, transfer=js.TransferFunction.from_points([0, 1], [(0, 0, 0), (1, 1, 1)], [0, 1]))
    for number in (0, 2, 3):
        paths[number].write_bytes(paths[number].read_bytes()[:900])
    rest = Snapshots.from_files(paths, transfer=whole.transfer, strict=False)
    assert rest.times == (0.5, 2.0, 2.5)
    assert [(file.path, file.before) for file in rest.survey.unread] == [(paths[0], -1), (paths[2], 0), (paths[3], 0)]
    for time in (0.5, 2.0, 2.3, 2.5):
        np.testing.assert_array_equal(rest.at(time).particles.position, whole.at(time).particles.position)
        assert rest.fingerprint(time) == whole.fingerprint(time)
    for time in (0.6, 1.0, 1.9):
        with pytest.raises(ValueError, match=r"no scene between times 0\.5 and 2: .*s_02.*s_03"):
            rest.at(time)
        with pytest.raises(ValueError, match="no scene between"):
            rest.fingerprint(time)
    each = rest.each()
    assert [getattr(source, "time", None) for source in each] == [None, 0.5, None, None, 2.0, 2.5]
    with pytest.raises(ValueError, match="s_03"):
        each[3]()
    for path in paths:
        path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(ValueError, match="none of 6 snapshots can be read"):
        Snapshots.from_files(paths, strict=False)


def test_a_missing_number_is_refused_unless_gaps_are_wanted(tmp_path):
    paths = [write(tmp_path, number) for number in (0, 1, 3)]
    with pytest.raises(ValueError, match="number 2 is missing"):
        Snapshots.from_files(paths)
    assert Snapshots.from_files(paths, gaps=True).times == (0, 0.5, 1.5)


def test_other_refusals_say_what_is_wrong(tmp_path):
    path = write(tmp_path, 0)
    with pytest.raises(ValueError, match="at least one"):
        Snapshots.from_files([])
    with pytest.raises(FileNotFoundError, match="none"):
        Snapshots.from_files([path, tmp_path / "none.npz"])
    with pytest.raises(ValueError, match="no quantity 'entropy'"):
        Snapshots.from_files([path], "entropy")
    with pytest.raises(ValueError, match=r"must lie in \[0, 0\]"):
        Snapshots.from_files([path]).at(1)
    with pytest.raises(TypeError, match="no argument `suport`; others that it has are color_by, opacity_by, support"):
        Snapshots.from_files([path], suport=1.0)


def test_progress_is_told_file_by_file(tmp_path):
    seen = []
    Snapshots.from_files([write(tmp_path, n) for n in range(3)], progress=lambda *count: seen.append(count))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def periodic(folder, number, shift):
    """Half of the particles across the faces of a unit box from where they were, and every other hot."""
    rng = np.random.default_rng(5)
    position = np.mod(rng.uniform(0, 1, (200, 3)) + (shift, 0, 0), 1)
    columns = {
        "temperature": np.where(np.arange(200) % 2, 1e3, 1e5) + 500.0 * (np.arange(200) % 7),
        "support": np.full(200, 0.2),
        "id": np.arange(200),
    }
    order = np.random.default_rng(number).permutation(200)
    path = folder / f"p_{number:02d}.npz"
    np.savez(path, position=position[order], time=0.5 * number, **{name: column[order] for name, column in columns.items()})
    return path


def test_a_condition_a_share_and_a_period_hold_for_all_moments(tmp_path):
    paths = [periodic(tmp_path, 0, 0.0), periodic(tmp_path, 1, 0.3)]
    wanted = {"box": (1, 1, 1), "where": "temperature > 1e4", "share": 0.4}
    snapshots = Snapshots.from_files(paths, "temperature", **wanted, center=(0.5, 0.5, 1.0))
    assert snapshots.survey.told()[0].endswith("40 matched, 0 vanish, 0 appear")  # of ids, the same in both files
    places = [np.asarray(snapshots.at(time).particles.exact_position()[:40]) for time in (0, 0.25, 0.5)]
    start = np.random.default_rng(5).uniform(0, 1, (200, 3))
    for place, shift in zip(places, (0, 0.15, 0.3), strict=True):
        away = place[:, None] - (start[::2] + (shift, 0, 0))
        assert (np.abs(away - np.round(away)).max(-1).min(1) < 1e-5).all()
        assert (place[:, 2] >= 0.5 - 1e-6).all() and (place[:, 2] <= 1.5 + 1e-6).all()
    found = snapshots.at(0.25).particles
    assert found.num_particles == 40 and found.box is not None and found.quantity[:40].min() > 1e4
    np.testing.assert_allclose(snapshots.bounds(), [(0, 0, 0.5), (1, 1, 1.5)])
    np.testing.assert_allclose(found.bounds(), snapshots.bounds(), atol=1e-6)
    assert any("left out by temperature > 1e4" in note for note in snapshots.survey.report.notes)


def test_what_is_shown_is_in_the_mark_of_a_moment(tmp_path):
    path = [periodic(tmp_path, 0, 0.0)]
    given = [{}, {"where": "temperature > 1e4"}, {"share": 0.5}, {"box": (1, 1, 1)}, {"within": js.Plane((0, 0, 0), (1, 0, 0))}]
    given += [{"box": (1, 1, 1), "center": (0, 0, 0)}, {"within": ~js.Plane((0, 0, 0), (1, 0, 0))}]
    given += [{"surface": js.Surface()}, {"surface": js.Surface(0.4)}]
    marks = [Snapshots.from_files(path, **more).fingerprint(0.0) for more in given]
    assert len(set(marks)) == len(marks)
    clip = js.Sphere((0.5, 0.5, 0.5), 0.3)
    shown = Snapshots.from_files(path, within=clip, surface=js.Surface(0.4)).at(0.0)
    assert shown.within is clip and shown.surface == js.Surface(0.4)


def test_volumes_and_densities_of_those_that_are_chosen_are_those_that_all_have_made(tmp_path):
    position = np.random.default_rng(0).normal(size=(150, 3)).astype(np.float32)
    np.savez(tmp_path / "a.npz", position=position, mass=np.ones(150), temperature=position[:, 0])
    for quantity in ("temperature", "log10:density"):
        whole = Snapshots.from_files([tmp_path / "a.npz"], quantity).at(0).particles.to_numpy()
        some = Snapshots.from_files([tmp_path / "a.npz"], quantity, where="temperature > 0").at(0).particles.to_numpy()
        for name, column in whole.items():
            np.testing.assert_allclose(some[name], column[position[:, 0] > 0], rtol=1e-6, err_msg=name)


def test_conditions_and_middles_that_make_no_sense_are_refused(tmp_path):
    paths = [periodic(tmp_path, number, 0.0) for number in range(2)]
    with pytest.raises(js.io.ConditionError, match=r"p_01\.npz: the condition 'entropy > 1'"):
        Snapshots.from_files(paths, where="entropy > 1")
    with pytest.raises(ValueError, match="200 left out by temperature > 1e9"):
        Snapshots.from_files(paths, where="temperature > 1e9")
    with pytest.raises(ValueError, match="`center` is for periodic boxes"):
        Snapshots.from_files(paths, center=(0, 0, 0))


def test_opacity_by_density_is_carried_from_file_to_file(tmp_path):
    density = np.geomspace(1e-3, 1, 200)
    paths = [write(tmp_path, number, density=(1 + number) * density, mass=np.ones(200)) for number in range(2)]
    snapshots = Snapshots.from_files(paths, "temperature", opacity_by="auto")
    found = snapshots.at(0.25)
    expected = np.log10(density) + 0.5 * np.log10(2)
    np.testing.assert_allclose(found.particles.to_numpy()["extinction_quantity"], expected, atol=1e-5)
    assert found.transfer.extinction_values is not None and float(found.transfer.extinction[0]) == 0
