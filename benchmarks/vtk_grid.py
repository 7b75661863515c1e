"""Claim: casting particles is nearer to the truth than resampling them to a grid, in less time.

What a user of VTK does today: `vtkSPHInterpolator` to a grid of cubes, then VTK's ray casting of that volume. The same particles,
kernel (cubic spline), camera and transfer function are rendered by jaxsph; the truth is an image of 8 times the samples. Colours
are compared, as VTK's image has 8 bits a channel (an error of 0.002 at least). All take turns in one process; compile time is
apart. Writes `results/vtk_grid.json`; ends in an assert on errors and times.

    pip install ".[vtk]"; python benchmarks/vtk_grid.py [--size 256] [--grids 128 256] [--repeats 3]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
from kept import keep

import jaxsph as js

SCENES = ("mixer", "dam_break")  # of equal supports, as the interpolator takes one
CONVERGED = 8
GRIDS = 128, 256
OUTSIDE = -1.0  # of the field where there is no particle: below all quantities, and transparent
OURS = {
    "full rate": js.Settings(),
    "samples/4": js.Settings(samples=64),
    "interval 0.004": js.Settings(integrator="samples", tolerance=0.004),
    "pilot 0.01": js.Settings(tolerance=0.01, estimator="pilot"),
}
RESULTS = peers.RESULTS.with_name("vtk_grid.json")
Frame = Callable[[], tuple[np.ndarray, dict[str, float]]]


def ours(scene: js.Scene, camera: js.Camera, settings: js.Settings) -> Frame:
    plan = js.plan(scene, camera, settings)

    def frame() -> tuple[np.ndarray, dict[str, float]]:
        image = js.render(scene, camera, settings, plan=plan)
        seconds = image.stats["seconds"]
        return np.asarray(image.color), {"resample": 0.0, "cast": sum(seconds[stage] for stage in ("grid", "adapt", "cast"))}

    return frame


def theirs(scene: js.Scene, camera: js.Camera, nodes: int) -> Frame:
    """A grid of cubes with `nodes` along the longest edge of the particles' box."""
    particles = scene.particles
    valid = np.asarray(particles.valid)
    position, quantity, support = (np.asarray(getattr(particles, name))[valid] for name in ("position", "quantity", "support"))
    assert support.min() == support.max(), "supports must be equal"
    points, column = vtk.vtkPoints(), numpy_to_vtk(quantity, deep=True)
    points.SetData(numpy_to_vtk(position, deep=True))
    column.SetName("quantity")
    source, kernel, grid, resample = vtk.vtkPolyData(), vtk.vtkSPHCubicKernel(), vtk.vtkImageData(), vtk.vtkSPHInterpolator()
    source.SetPoints(points)
    source.GetPointData().AddArray(column)
    kernel.SetDimension(3)
    kernel.SetSpatialStep(float(support[0]) / 2)
    lower, upper = position.min(0) - support[0], position.max(0) + support[0]
    spacing = float((upper - lower).max()) / (nodes - 1)
    grid.SetDimensions(*(int(np.ceil(edge / spacing)) + 1 for edge in upper - lower))
    grid.SetOrigin(*lower.astype(float))
    grid.SetSpacing(spacing, spacing, spacing)
    resample.SetInputData(grid)
    resample.SetSourceData(source)
    resample.SetKernel(kernel)
    resample.ShepardNormalizationOn()
    window, mapper = _window(scene.transfer, camera)

    def frame() -> tuple[np.ndarray, dict[str, float]]:
        started = time.perf_counter()
        source.Modified()
        resample.Modified()
        resample.Update()
        field = resample.GetOutput()
        sums = vtk_to_numpy(field.GetPointData().GetArray("Shepard Summation"))
        vtk_to_numpy(field.GetPointData().GetArray("quantity"))[sums <= 0] = OUTSIDE
        field.GetPointData().SetActiveScalars("quantity")
        resampled = time.perf_counter()
        mapper.SetInputData(field)
        window.Render()
        reader = vtk.vtkWindowToImageFilter()
        reader.SetInput(window)
        reader.ReadFrontBufferOff()
        reader.Update()
        pixels = vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
        image = pixels.reshape(camera.height, camera.width, 3)[::-1] / 255
        return image, {"resample": resampled - started, "cast": time.perf_counter() - resampled}

    return frame


def _window(transfer: js.TransferFunction, camera: js.Camera) -> tuple[vtk.vtkRenderWindow, vtk.vtkVolumeMapper]:
    """The same view of a volume yet to be given, with samples as far apart as ours are on average."""
    step = float(camera.far - camera.near) / js.Settings().samples
    colors, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    values = np.asarray(transfer.values, float)
    for value, color, extinction in zip(values, np.asarray(transfer.colors), np.asarray(transfer.extinction), strict=True):
        colors.AddRGBPoint(value, *color.astype(float))
        opacity.AddPoint(value, -np.expm1(-float(extinction) * step))
    opacity.AddPoint(OUTSIDE, 0)
    opacity.AddPoint(values[0] - 1e-3 * (values[-1] - values[0]), 0)
    look, mapper, volume = vtk.vtkVolumeProperty(), vtk.vtkFixedPointVolumeRayCastMapper(), vtk.vtkVolume()
    look.SetColor(colors)
    look.SetScalarOpacity(opacity)
    look.SetScalarOpacityUnitDistance(step)
    look.SetInterpolationTypeToLinear()
    mapper.SetSampleDistance(step)
    mapper.AutoAdjustSampleDistancesOff()
    mapper.SetImageSampleDistance(1)
    volume.SetMapper(mapper)
    volume.SetProperty(look)
    renderer, window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
    renderer.SetBackground(0, 0, 0)
    renderer.AddVolume(volume)
    window.OffScreenRenderingOn()
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)
    view, eye, axes = renderer.GetActiveCamera(), np.asarray(camera.eye, float), np.asarray(camera.axes, float)
    view.SetPosition(*eye)
    view.SetFocalPoint(*(eye + axes[2]))
    view.SetViewUp(*axes[1])
    view.SetViewAngle(2 * np.degrees(np.arctan(float(camera.half_height))))
    view.SetClippingRange(float(camera.near), float(camera.far))
    return window, mapper


def measure(name: str, arguments: argparse.Namespace) -> list[dict]:
    """One record a contender: errors against the truth, median seconds."""
    scene, camera = js.scenes.load(name, width=arguments.size, height=arguments.size)
    scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, kernel="cubic_spline"))
    truth = np.asarray(js.render(scene, camera, js.Settings(samples=CONVERGED * js.Settings().samples)).color)
    frames = {f"VTK, {nodes} nodes": theirs(scene, camera, nodes) for nodes in arguments.grids}
    frames |= {f"jaxsph, {label}": ours(scene, camera, settings) for label, settings in OURS.items()}
    errors = {label: np.abs(frame()[0] - truth) for label, frame in frames.items()}
    turns: dict[str, list[dict[str, float]]] = {label: [] for label in frames}
    for _ in range(arguments.repeats):
        for label, frame in frames.items():
            turns[label].append(frame()[1])
    records = []
    for label, error in errors.items():
        stages = {stage: statistics.median(turn[stage] for turn in turns[label]) for stage in ("resample", "cast")}
        total = statistics.median(sum(turn.values()) for turn in turns[label])
        found = {"max_error": float(error.max()), "mean_error": float(error.mean())}
        records.append({"scene": name, "size": arguments.size, "contender": label, **found, **stages, "total": total})
    return records


def variants() -> list[str]:
    """Names of all that is compared."""
    return [*(f"VTK, {nodes} nodes" for nodes in GRIDS), *(f"jaxsph, {label}" for label in OURS)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256, help="pixels on a side")
    parser.add_argument("--grids", type=int, nargs="+", default=GRIDS, help="nodes along the longest edge")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    print(f"{'scene':12s} {'contender':22s} max error  mean error  resample     cast    total")
    records = []
    for name in arguments.scenes:
        for record in measure(name, arguments):
            errors = f"{record['max_error']:9.4f} {record['mean_error']:11.5f}"
            seconds = f"{record['resample']:9.3f}{record['cast']:9.3f}{record['total']:9.3f}"
            print(f"{name:12s} {record['contender']:22s} {errors} {seconds}", flush=True)
            records.append(record)
    names = [record["contender"] for record in records]
    keep(RESULTS, names, packages=["vtk"], repeats=arguments.repeats, records=records)
    for name in arguments.scenes:
        mine, grids = ([r for r in records if r["scene"] == name and r["contender"].startswith(who)] for who in ("jaxsph", "VTK"))
        for grid in grids:
            better = any(r["mean_error"] <= grid["mean_error"] and r["total"] <= grid["total"] for r in mine)
            assert better, f"{name}: nothing beats {grid['contender']}"


if __name__ == "__main__":
    main()
