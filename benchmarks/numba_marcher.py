"""The peer: a packet ray marcher for equal supports, written by hand in Numba, as fast as it could be made.

Particles are counting-sorted into a uniform grid whose cells are as wide as a support, x fastest. A packet of 8 x 8 pixels and
`steps` samples culls the particles of the grid cells around it into one list with a sphere-against-box test, and evaluates
that list with the packet's samples across the lanes. CSPH-normalised, emission-absorption, 256-entry transfer table. No
adaptivity, no early termination, no variable supports; samples are uniform in depth.
"""

from __future__ import annotations

import math

import numba
import numpy as np

F = np.float32
ROOM = 65536  # candidates of a packet


@numba.njit(fastmath=True)
def build(position, support, quantity, origin, cells):
    """Counting sort into cells of one support, with a border of one empty cell on every side."""
    nx, ny, nz = cells
    inverse = F(1) / support
    count = position.shape[0]
    cell = np.empty(count, np.int32)
    start = np.zeros(nx * ny * nz + 1, np.int32)
    for i in range(count):
        x = min(max(int((position[i, 0] - origin[0]) * inverse), 0), nx - 3) + 1
        y = min(max(int((position[i, 1] - origin[1]) * inverse), 0), ny - 3) + 1
        z = min(max(int((position[i, 2] - origin[2]) * inverse), 0), nz - 3) + 1
        cell[i] = (z * ny + y) * nx + x
        start[cell[i] + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    place = start[:-1].copy()
    sorted_columns = np.empty((4, count), np.float32)
    for i in range(count):
        k = place[cell[i]]
        place[cell[i]] += 1
        sorted_columns[0, k] = position[i, 0]
        sorted_columns[1, k] = position[i, 1]
        sorted_columns[2, k] = position[i, 2]
        sorted_columns[3, k] = quantity[i]
    return start, sorted_columns


def _weigher(kernel):
    if kernel == "cubic_spline":

        @numba.njit(fastmath=True, inline="always")
        def weigh(square):
            q = np.sqrt(square)
            outer = max(F(1) - q, F(0))
            inner = max(F(0.5) - q, F(0))
            return F(2) * outer * outer * outer - F(8) * inner * inner * inner

    else:

        @numba.njit(fastmath=True, inline="always")
        def weigh(square):
            t = max(F(1) - square, F(0))
            return t * t * t

    return weigh


def marcher(kernel="cubic_spline", steps=4):
    """A compiled `render(start, columns, support, origin, cells, table, eye, half, near, far, size, samples)`.

    The camera stands at `eye` and looks along +z with y downwards; `half` is the tangent of half the field of view.
    """
    weigh = _weigher(kernel)
    side, lanes = 8, 64 * steps

    @numba.njit(fastmath=True, parallel=True)
    def render(start, columns, support, origin, cells, table, eye, half, near, far, size, samples):
        nx, ny, nz = cells
        image = np.empty((size, size, 4), np.float32)
        xs, ys, zs, qs = columns[0], columns[1], columns[2], columns[3]
        inverse, square_support = F(1) / support, support * support
        entries = table.shape[0]
        step = F((far - near) / samples)
        tiles = (size + side - 1) // side
        for tile in numba.prange(tiles * tiles):
            top, left = (tile // tiles) * side, (tile % tiles) * side
            sx, sy, sz = np.empty(lanes, F), np.empty(lanes, F), np.empty(lanes, F)
            total, weighted = np.empty(lanes, F), np.empty(lanes, F)
            u, v, length = np.empty(64, F), np.empty(64, F), np.empty(64, F)
            ray = np.zeros((64, 4), F)
            lx, ly, lz, lq = np.empty(ROOM, F), np.empty(ROOM, F), np.empty(ROOM, F), np.empty(ROOM, F)
            for p in range(64):
                u[p] = F(((left + p % side + 0.5) / size * 2 - 1) * half)
                v[p] = F(((top + p // side + 0.5) / size * 2 - 1) * half)
                length[p] = F(step * math.sqrt(1 + u[p] * u[p] + v[p] * v[p]))
                ray[p, 3] = F(1)
            for first in range(0, samples, steps):
                x0, x1, y0, y1, z0, z1 = F(1e30), F(-1e30), F(1e30), F(-1e30), F(1e30), F(-1e30)
                for j in range(steps):
                    s = F(near + (first + j + 0.5) * step)
                    for p in range(64):
                        k = j * 64 + p
                        x, y, z = u[p] * s + eye[0], v[p] * s + eye[1], s + eye[2]
                        sx[k], sy[k], sz[k] = x, y, z
                        total[k], weighted[k] = F(0), F(0)
                        x0, x1 = min(x0, x), max(x1, x)
                        y0, y1 = min(y0, y), max(y1, y)
                        z0, z1 = min(z0, z), max(z1, z)
                ca = min(max(int(math.floor((x0 - support - origin[0]) * inverse)), -1), nx - 2) + 1
                cb = min(max(int(math.floor((x1 + support - origin[0]) * inverse)), -1), nx - 2) + 1
                da = min(max(int(math.floor((y0 - support - origin[1]) * inverse)), -1), ny - 2) + 1
                db = min(max(int(math.floor((y1 + support - origin[1]) * inverse)), -1), ny - 2) + 1
                ea = min(max(int(math.floor((z0 - support - origin[2]) * inverse)), -1), nz - 2) + 1
                eb = min(max(int(math.floor((z1 + support - origin[2]) * inverse)), -1), nz - 2) + 1
                mx, hx = F(0.5) * (x0 + x1), F(0.5) * (x1 - x0)
                my, hy = F(0.5) * (y0 + y1), F(0.5) * (y1 - y0)
                mz, hz = F(0.5) * (z0 + z1), F(0.5) * (z1 - z0)
                found = np.uint64(0)
                for cz in range(ea, eb + 1):
                    for cy in range(da, db + 1):
                        row = (cz * ny + cy) * nx
                        for k in range(np.uint64(start[row + ca]), np.uint64(start[row + cb + 1])):
                            dx = max(abs(xs[k] - mx) - hx, F(0))
                            dy = max(abs(ys[k] - my) - hy, F(0))
                            dz = max(abs(zs[k] - mz) - hz, F(0))
                            lx[found], ly[found], lz[found], lq[found] = xs[k], ys[k], zs[k], qs[k]
                            found += np.uint64(dx * dx + dy * dy + dz * dz < square_support)
                if found == 0:
                    continue
                for k in range(found):
                    px, py, pz, pq = lx[k], ly[k], lz[k], lq[k]
                    for lane in range(np.uint64(lanes)):
                        dx = (sx[lane] - px) * inverse
                        dy = (sy[lane] - py) * inverse
                        dz = (sz[lane] - pz) * inverse
                        w = weigh(dx * dx + dy * dy + dz * dz)
                        total[lane] += w
                        weighted[lane] += w * pq
                for j in range(steps):
                    for p in range(64):
                        k = j * 64 + p
                        if total[k] > F(1e-12):
                            place = min(max(weighted[k] / total[k], F(0)), F(1)) * F(entries - 1)
                            i = min(int(place), entries - 2)
                            part = place - F(i)
                            extinction = table[i, 3] + part * (table[i + 1, 3] - table[i, 3])
                            passed = F(math.exp(-extinction * length[p]))
                            gain = ray[p, 3] * (F(1) - passed)
                            for channel in range(3):
                                low = table[i, channel]
                                ray[p, channel] += gain * (low + part * (table[i + 1, channel] - low))
                            ray[p, 3] *= passed
            for p in range(64):
                r, c = top + p // side, left + p % side
                if r < size and c < size:
                    image[r, c, 0], image[r, c, 1], image[r, c, 2] = ray[p, 0], ray[p, 1], ray[p, 2]
                    image[r, c, 3] = F(1) - ray[p, 3]
        return image

    return render
