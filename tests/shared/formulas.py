"""The kernels as their sources print them, by q = distance over support, float64 NumPy: what the library's are held against."""

import numpy as np


def ahead(q, knot, power):
    return np.maximum(knot - q, 0) ** power


# Price 2012, JCP 231, equations 6 to 8, with knots over the support; Dehnen & Aly 2012, table 1; Mueller, Charypar & Gross 2003.
KERNELS = {
    "poly6": lambda q: 315 / (64 * np.pi) * np.maximum(1 - q * q, 0) ** 3,
    "cubic_spline": lambda q: 8 / np.pi * (2 * ahead(q, 1, 3) - 8 * ahead(q, 0.5, 3)),
    "wendland_c2": lambda q: 21 / (2 * np.pi) * ahead(q, 1, 4) * (1 + 4 * q),
    "quartic_spline": lambda q: 5**6 / (512 * np.pi) * (ahead(q, 1, 4) - 5 * ahead(q, 0.6, 4) + 10 * ahead(q, 0.2, 4)),
    "quintic_spline": lambda q: 3**7 / (40 * np.pi) * (ahead(q, 1, 5) - 6 * ahead(q, 2 / 3, 5) + 15 * ahead(q, 1 / 3, 5)),
    "wendland_c4": lambda q: 495 / (32 * np.pi) * ahead(q, 1, 6) * (1 + 6 * q + 35 / 3 * q**2),
    "wendland_c6": lambda q: 1365 / (64 * np.pi) * ahead(q, 1, 8) * (1 + 8 * q + 25 * q**2 + 32 * q**3),
}
