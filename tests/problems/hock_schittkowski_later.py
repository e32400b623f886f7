"""Further problems of Hock and Schittkowski, from number 55 on: more unknowns, worse scales, engineering formulas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy import exp, log, sin, sqrt

from problems.hock_schittkowski import INF, ROOT2, Case, banana, product

ARC = math.asin(math.sqrt(1 / 4.2))
HS57_A = [8, 8] + 4 * [10] + 4 * [12] + 3 * [14] + 3 * [16] + 2 * [18] + 3 * [20] + 3 * [22] + 3 * [24] + 3 * [26]
HS57_A += [28, 28, 30, 30, 30, 32, 32, 34, 36, 36, 38, 38, 40, 42]
HS57_B = [49, 49, 48, 47, 48, 47, 46, 46, 45, 43, 45, 43, 43, 44, 43, 43, 46, 45, 42, 42, 43, 41, 41, 40, 42, 40, 40]
HS57_B += [41, 40, 41, 41, 40, 40, 40, 38, 41, 40, 40, 41, 38, 40, 40, 39, 39]

# Colville's first problem.
COLVILLE_A = np.array(
    [
        [-16, 2, 0, 1, 0], [0, -2, 0, 0.4, 2], [-3.5, 0, 2, 0, 0], [0, -2, 0, -4, -1], [0, -9, -2, 1, -2.8],
        [2, 0, -4, 0, 0], [-1, -1, -1, -1, -1], [-1, -2, -3, -2, -1], [1, 2, 3, 4, 5], [1, 1, 1, 1, 1],
    ]
)  # fmt: skip
COLVILLE_B = np.array([-40, -2, -0.25, -4, -4, -1, -40, -60, 5, 1])
COLVILLE_C = np.array(
    [[30, -20, -10, 32, -10], [-20, 39, -6, -31, 32], [-10, -6, 10, -6, -10], [32, -31, -6, 39, -20],
     [-10, 32, -10, -20, 30]]
)  # fmt: skip
COLVILLE_D, COLVILLE_E = np.array([4, 8, 10, 6, 2]), np.array([-15, -27, -36, -18, -12])

HS112_C = [-6.089, -17.164, -34.054, -5.914, -24.721, -14.986, -24.100, -10.708, -26.662, -22.179]
HS268_D = [[-74, 80, 18, -11, -4], [14, -69, 21, 28, 0], [66, -72, -5, 7, 1], [-12, 66, -30, -23, 3], [3, 8, -7, -4, 1],
           [4, -12, 4, 4, 0]]  # fmt: skip
HS268_RIGHT = [51, -61, -56, 69, 10, -12]


def dot(coefficients: Any, x: Any) -> Any:
    """Sum of products; zeros are left out."""
    return sum(float(c) * value for c, value in zip(coefficients, x, strict=True) if c)


def hs62(x: Any, y: Any, z: Any) -> Any:
    """In thousands of the collection's unit."""
    total = 255 * log((x + y + z + 0.03) / (0.09 * x + y + z + 0.03))
    total = total + 280 * log((y + z + 0.03) / (0.07 * y + z + 0.03)) + 290 * log((z + 0.03) / (0.13 * z + 0.03))
    return -0.032174 * total


def hs74(limit: float, best: float) -> Case:
    """Two generators and three nodes; numbers 74 and 75 differ in the limit of the angles. In thousands."""
    return Case(
        name="HS74" if limit > 0.5 else "HS75", start=(0, 0, 0, 0), best=best,
        lower=(0, 0, -limit, -limit), upper=(1200, 1200, limit, limit),
        cost=lambda a, b, c, d: 1e-3 * (3 * a + 1e-6 * a**3 + 2 * b + 2e-6 / 3 * b**3),
        least=lambda a, b, c, d: [d - c + limit, c - d + limit],
        equal=lambda a, b, c, d: [
            1000 * sin(-c - 0.25) + 1000 * sin(-d - 0.25) + 894.8 - a,
            1000 * sin(c - 0.25) + 1000 * sin(c - d - 0.25) + 894.8 - b,
            1000 * sin(d - 0.25) + 1000 * sin(d - c - 0.25) + 1294.8,
        ],
    )  # fmt: skip


def hs83_rows(a: Any, b: Any, c: Any, d: Any, e: Any) -> list[Any]:
    """Colville 3: three expressions between two limits each."""
    rows = [
        (85.334407 + 0.0056858 * b * e + 0.0006262 * a * d - 0.0022053 * c * e, 0, 92),
        (80.51249 + 0.0071317 * b * e + 0.0029955 * a * b + 0.0021813 * c**2, 90, 110),
        (9.300961 + 0.0047026 * c * e + 0.0012547 * a * c + 0.0019085 * c * d, 20, 25),
    ]
    return [side for value, low, high in rows for side in (value - low, high - value)]


def hs95(number: int, b: tuple[float, float, float, float], best: float) -> Case:
    """Numbers 95 to 98 differ in four limits."""
    others = (4.07124636,) if number > 96 else ()
    return Case(
        name=f"HS{number}", start=6 * (0,), best=best, others=others, lower=0,
        upper=(0.31, 0.046, 0.068, 0.042, 0.028, 0.0134),
        cost=lambda *x: dot([4.3, 31.8, 63.3, 15.8, 68.5, 4.7], x),
        least=lambda *x: [
            dot([17.1, 38.2, 204.2, 212.3, 623.4, 1495.5], x) - 169 * x[0] * x[2] - 3580 * x[2] * x[4]
            - 3810 * x[3] * x[4] - 18500 * x[3] * x[5] - 24300 * x[4] * x[5] - b[0],
            dot([17.9, 36.8, 113.9, 169.7, 337.8, 1385.2], x) - 139 * x[0] * x[2] - 2450 * x[3] * x[4]
            - 16600 * x[3] * x[5] - 17200 * x[4] * x[5] - b[1],
            -273 * x[1] - 70 * x[3] - 819 * x[4] + 26000 * x[3] * x[4] - b[2],
            159.9 * x[0] - 311 * x[1] + 587 * x[3] + 391 * x[4] + 2198 * x[5] - 14000 * x[0] * x[5] - b[3],
        ],
    )  # fmt: skip


def hs104_rows(*x: Any) -> list[Any]:
    """Reactor design."""
    f = 0.4 * (x[0] / x[6]) ** 0.67 + 0.4 * (x[1] / x[7]) ** 0.67 + 10 - x[0] - x[1]
    return [
        1 - 0.0588 * x[4] * x[6] - 0.1 * x[0],
        1 - 0.0588 * x[5] * x[7] - 0.1 * x[0] - 0.1 * x[1],
        1 - 4 * x[2] / x[4] - 2 / (x[2] ** 0.71 * x[4]) - 0.0588 * x[6] / x[2] ** 1.3,
        1 - 4 * x[3] / x[5] - 2 / (x[3] ** 0.71 * x[5]) - 0.0588 * x[7] / x[3] ** 1.3,
        f - 1, 4.2 - f,
    ]  # fmt: skip


def hs108_rows(*x: Any) -> list[Any]:
    """The largest hexagon of unit diameter."""

    def apart(i: int, j: int) -> Any:
        return 1 - (x[i] - x[j]) ** 2 - (x[i + 1] - x[j + 1]) ** 2

    return [
        1 - x[2] ** 2 - x[3] ** 2, 1 - x[8] ** 2, 1 - x[4] ** 2 - x[5] ** 2, 1 - x[0] ** 2 - (x[1] - x[8]) ** 2,
        apart(0, 4), apart(0, 6), apart(2, 4), apart(2, 6), 1 - x[6] ** 2 - (x[7] - x[8]) ** 2,
        x[0] * x[3] - x[1] * x[2], x[2] * x[8], -x[4] * x[8], x[4] * x[7] - x[5] * x[6],
    ]  # fmt: skip


def hs112(*x: Any) -> Any:
    """Chemical equilibrium."""
    total = sum(x[1:], x[0])
    return sum(value * (c + log(value / total)) for c, value in zip(HS112_C, x, strict=True))


def hs113_rows(*x: Any) -> list[Any]:
    """Wong's second problem."""
    return [
        105 - 4 * x[0] - 5 * x[1] + 3 * x[6] - 9 * x[7], -10 * x[0] + 8 * x[1] + 17 * x[6] - 2 * x[7],
        8 * x[0] - 2 * x[1] - 5 * x[8] + 2 * x[9] + 12,
        -3 * (x[0] - 2) ** 2 - 4 * (x[1] - 3) ** 2 - 2 * x[2] ** 2 + 7 * x[3] + 120,
        -5 * x[0] ** 2 - 8 * x[1] - (x[2] - 6) ** 2 + 2 * x[3] + 40,
        -0.5 * (x[0] - 8) ** 2 - 2 * (x[1] - 4) ** 2 - 3 * x[4] ** 2 + x[5] + 30,
        -(x[0] ** 2) - 2 * (x[1] - 2) ** 2 + 2 * x[0] * x[1] - 14 * x[4] + 6 * x[5],
        3 * x[0] - 6 * x[1] - 12 * (x[8] - 8) ** 2 + 7 * x[9],
    ]  # fmt: skip


LATER = [
    Case(
        name="HS55", start=(1, 2, 0, 0, 0, 2), best=19 / 3, others=(20 / 3,), lower=0, upper=(1, INF, INF, 1, INF, INF),
        cost=lambda a, b, c, d, e, f: a + 2 * b + 4 * e + exp(a * d),
        equal=lambda a, b, c, d, e, f: [
            a + 2 * b + 5 * e - 6, a + b + c - 3, d + e + f - 2, a + d - 1, b + e - 2, c + f - 2,
        ],
    ),
    Case(
        name="HS56", start=(1, 1, 1, ARC, ARC, ARC, math.asin(math.sqrt(5 / 7.2))), best=-3.456, others=(0.0,),
        cost=lambda *x: -x[0] * x[1] * x[2],
        equal=lambda *x: [
            *(x[k] - 4.2 * sin(x[3 + k]) ** 2 for k in range(3)),
            x[0] + 2 * x[1] + 2 * x[2] - 7.2 * sin(x[6]) ** 2,
        ],
    ),
    Case(
        name="HS57", start=(0.42, 5), best=0.02845966972, others=(0.03064767,), lower=(0.4, -4),
        squares=lambda x, y: [
            0.01 * b - x - (0.49 - x) * exp(-y * (a - 8)) for a, b in zip(HS57_A, HS57_B, strict=True)
        ],
        least=lambda x, y: [0.49 * y - x * y - 0.09],
    ),
    Case(
        name="HS58", start=(-2, 1), best=3.19033354957, squares=banana, lower=(-2, -INF), upper=(0.5, INF),
        least=lambda x, y: [y**2 - x, x**2 - y, x**2 + y**2 - 1],
    ),
    Case(
        name="HS60", start=(2, 2, 2), best=0.03256820025, squares=lambda x, y, z: [x - 1, x - y, (y - z) ** 2],
        equal=lambda x, y, z: [x * (1 + y**2) + z**4 - 4 - 3 * ROOT2], lower=-10, upper=10,
    ),
    Case(
        name="HS61", start=(0, 0, 0), best=-143.6461422,
        cost=lambda x, y, z: 4 * x**2 + 2 * y**2 + 2 * z**2 - 33 * x + 16 * y - 24 * z,
        equal=lambda x, y, z: [3 * x - 2 * y**2 - 7, 4 * x - z**2 - 11],
    ),
    Case(
        name="HS62", start=(0.7, 0.2, 0.1), best=-26.27251448, cost=hs62, equal=lambda x, y, z: [x + y + z - 1],
        lower=0, upper=1,
    ),
    Case(
        name="HS63", start=(2, 2, 2), best=961.7151721, lower=0,
        cost=lambda x, y, z: 1000 - x**2 - 2 * y**2 - z**2 - x * y - x * z,
        equal=lambda x, y, z: [8 * x + 14 * y + 7 * z - 56, x**2 + y**2 + z**2 - 25],
    ),
    Case(
        name="HS64", start=(1, 1, 1), best=6299.842428, lower=1e-5,
        cost=lambda x, y, z: 5 * x + 5e4 / x + 20 * y + 7.2e4 / y + 10 * z + 1.44e5 / z,
        least=lambda x, y, z: [1 - 4 / x - 32 / y - 120 / z],
    ),
    Case(
        name="HS65", start=(-5, 5, 0), best=0.9535288567, lower=(-4.5, -4.5, -5), upper=(4.5, 4.5, 5),
        squares=lambda x, y, z: [x - y, (x + y - 10) / 3, z - 5], least=lambda x, y, z: [48 - x**2 - y**2 - z**2],
    ),
    Case(
        name="HS66", start=(0, 1.05, 2.9), best=0.5181632741, cost=lambda x, y, z: 0.2 * z - 0.8 * x,
        least=lambda x, y, z: [y - exp(x), z - exp(y)], lower=0, upper=(100, 100, 10),
    ),
    Case(
        name="HS71", start=(1, 5, 5, 1), best=17.0140173, cost=lambda a, b, c, d: a * d * (a + b + c) + c,
        least=lambda a, b, c, d: [a * b * c * d - 25], equal=lambda a, b, c, d: [a**2 + b**2 + c**2 + d**2 - 40],
        lower=1, upper=5,
    ),
    Case(
        name="HS72", start=(1, 1, 1, 1), best=727.67937, cost=lambda a, b, c, d: 1 + a + b + c + d,
        least=lambda a, b, c, d: [
            0.0401 - 4 / a - 2.25 / b - 1 / c - 0.25 / d, 0.010085 - 0.16 / a - 0.36 / b - 0.64 / c - 0.64 / d,
        ],
        lower=0.001, upper=(4e5, 3e5, 2e5, 1e5),
    ),
    Case(
        name="HS73", start=(1, 1, 1, 1), best=29.89437816, cost=lambda *x: dot([24.55, 26.75, 39, 40.5], x), lower=0,
        least=lambda a, b, c, d: [
            2.3 * a + 5.6 * b + 11.1 * c + 1.3 * d - 5,
            12 * a + 11.9 * b + 41.8 * c + 52.1 * d - 21
            - 1.645 * sqrt(0.28 * a**2 + 0.19 * b**2 + 20.5 * c**2 + 0.62 * d**2),
        ],
        equal=lambda a, b, c, d: [a + b + c + d - 1],
    ),
    hs74(0.55, 5.1264981),
    hs74(0.48, 5.1744129),
    Case(
        name="HS76", start=(0.5, 0.5, 0.5, 0.5), best=-4.681818181, lower=0,
        cost=lambda a, b, c, d: a**2 + b**2 / 2 + c**2 + d**2 / 2 - a * c + c * d - a - 3 * b + c - d,
        least=lambda a, b, c, d: [5 - a - 2 * b - c - d, 4 - 3 * a - b - 2 * c + d, b + 4 * c - 1.5],
    ),
    Case(
        name="HS77", start=(2, 2, 2, 2, 2), best=0.24150513,
        squares=lambda a, b, c, d, e: [a - 1, a - b, c - 1, (d - 1) ** 2, (e - 1) ** 3],
        equal=lambda a, b, c, d, e: [a**2 * d + sin(d - e) - 2 * ROOT2, b + c**4 * d**2 - 8 - ROOT2],
    ),
    Case(
        name="HS78", start=(-2, 1.5, 2, -1, -1), best=-2.91970041, cost=product,
        equal=lambda a, b, c, d, e: [a**2 + b**2 + c**2 + d**2 + e**2 - 10, b * c - 5 * d * e, a**3 + b**3 + 1],
    ),
    Case(
        name="HS79", start=(2, 2, 2, 2, 2), best=0.0787768209,
        squares=lambda a, b, c, d, e: [a - 1, a - b, b - c, (c - d) ** 2, (d - e) ** 2],
        equal=lambda a, b, c, d, e: [a + b**2 + c**3 - 2 - 3 * ROOT2, b - c**2 + d + 2 - 2 * ROOT2, a * e - 2],
    ),
    Case(
        name="HS80", start=(-2, 2, 2, -1, -1), best=0.0539498478, cost=lambda *x: exp(product(*x)),
        equal=lambda a, b, c, d, e: [a**2 + b**2 + c**2 + d**2 + e**2 - 10, b * c - 5 * d * e, a**3 + b**3 + 1],
        lower=(-2.3, -2.3, -3.2, -3.2, -3.2), upper=(2.3, 2.3, 3.2, 3.2, 3.2),
    ),
    Case(
        name="HS81", start=(-2, 2, 2, -1, -1), best=0.0539498478, others=(0.4388512199,),
        cost=lambda *x: exp(product(*x)) - 0.5 * (x[0] ** 3 + x[1] ** 3 + 1) ** 2,
        equal=lambda a, b, c, d, e: [a**2 + b**2 + c**2 + d**2 + e**2 - 10, b * c - 5 * d * e, a**3 + b**3 + 1],
        lower=(-2.3, -2.3, -3.2, -3.2, -3.2), upper=(2.3, 2.3, 3.2, 3.2, 3.2),
    ),
    Case(
        name="HS83", start=(78, 33, 27, 27, 27), best=-30665.53867, least=hs83_rows,
        cost=lambda a, b, c, d, e: 5.3578547 * c**2 + 0.8356891 * a * e + 37.293239 * a - 40792.141,
        lower=(78, 33, 27, 27, 27), upper=(102, 45, 45, 45, 45),
    ),
    Case(
        name="HS86", start=(0, 0, 0, 0, 1), best=-32.34867897, lower=0,
        cost=lambda *x: (
            dot(COLVILLE_E, x) + sum(x[k] * dot(COLVILLE_C[k], x) + COLVILLE_D[k] * x[k] ** 3 for k in range(5))
        ),
        least=lambda *x: [dot(row, x) - b for row, b in zip(COLVILLE_A, COLVILLE_B, strict=True)],
    ),
    Case(
        name="HS93", start=(5.54, 4.4, 12.02, 11.8, 0.702, 0.852), best=135.075961, lower=0,
        cost=lambda a, b, c, d, e, f: (
            0.0204 * a * d * (a + b + c) + 0.0187 * b * c * (a + 1.57 * b + d)
            + 0.0607 * a * d * e**2 * (a + b + c) + 0.0437 * b * c * f**2 * (a + 1.57 * b + d)
        ),
        least=lambda a, b, c, d, e, f: [
            0.001 * a * b * c * d * e * f - 2.07,
            1 - 0.00062 * a * d * e**2 * (a + b + c) - 0.00058 * b * c * f**2 * (a + 1.57 * b + d),
        ],
    ),
    hs95(95, (4.97, -1.88, -29.08, -78.02), 0.015619525242),
    hs95(96, (4.97, -1.88, -69.08, -118.02), 0.015619525242),
    hs95(97, (32.97, 25.12, -29.08, -78.02), 3.1358091),
    hs95(98, (32.97, 25.12, -124.08, -173.02), 3.1358091),
    Case(
        name="HS100", start=(1, 2, 0, 4, 0, 1, 1), best=680.6300573,
        cost=lambda *x: (
            (x[0] - 10) ** 2 + 5 * (x[1] - 12) ** 2 + x[2] ** 4 + 3 * (x[3] - 11) ** 2 + 10 * x[4] ** 6
            + 7 * x[5] ** 2 + x[6] ** 4 - 4 * x[5] * x[6] - 10 * x[5] - 8 * x[6]
        ),
        least=lambda *x: [
            127 - 2 * x[0] ** 2 - 3 * x[1] ** 4 - x[2] - 4 * x[3] ** 2 - 5 * x[4],
            282 - 7 * x[0] - 3 * x[1] - 10 * x[2] ** 2 - x[3] + x[4],
            196 - 23 * x[0] - x[1] ** 2 - 6 * x[5] ** 2 + 8 * x[6],
            -4 * x[0] ** 2 - x[1] ** 2 + 3 * x[0] * x[1] - 2 * x[2] ** 2 - 5 * x[5] + 11 * x[6],
        ],
    ),
    Case(
        name="HS104", start=(6, 3, 0.4, 0.2, 6, 6, 1, 0.5), best=3.9511634396, lower=0.1, upper=10, least=hs104_rows,
        cost=lambda *x: 0.4 * (x[0] / x[6]) ** 0.67 + 0.4 * (x[1] / x[7]) ** 0.67 + 10 - x[0] - x[1],
    ),
    Case(
        name="HS106", start=(5000, 5000, 5000, 200, 350, 150, 225, 425), best=7049.2480,
        cost=lambda *x: x[0] + x[1] + x[2],
        least=lambda *x: [
            1 - 0.0025 * (x[3] + x[5]), 1 - 0.0025 * (x[4] + x[6] - x[3]), 1 - 0.01 * (x[7] - x[4]),
            x[0] * x[5] - 833.33252 * x[3] - 100 * x[0] + 83333.333,
            x[1] * x[6] - 1250 * x[4] - x[1] * x[3] + 1250 * x[3],
            x[2] * x[7] - 1.25e6 - x[2] * x[4] + 2500 * x[4],
        ],
        lower=(100, 1000, 1000, 10, 10, 10, 10, 10), upper=(1e4, 1e4, 1e4, 1e3, 1e3, 1e3, 1e3, 1e3),
    ),
    Case(
        name="HS108", start=9 * (1,), best=-0.8660254038, others=(-0.6749814,), lower=(*8 * (-INF,), 0),
        least=hs108_rows,
        cost=lambda *x: (
            -0.5 * (x[0] * x[3] - x[1] * x[2] + x[2] * x[8] - x[4] * x[8] + x[4] * x[7] - x[5] * x[6])
        ),
    ),
    Case(
        name="HS110", start=10 * (9,), best=-45.77846971, lower=2.001, upper=9.999,
        cost=lambda *x: sum(log(v - 2) ** 2 + log(10 - v) ** 2 for v in x) - product(*x) ** 0.2,
    ),
    Case(
        name="HS112", start=10 * (0.1,), best=-47.76109086, judged=5e-5, cost=hs112, lower=1e-6,
        equal=lambda *x: [
            x[0] + 2 * x[1] + 2 * x[2] + x[5] + x[9] - 2, x[3] + 2 * x[4] + x[5] + x[6] - 1,
            x[2] + x[6] + x[7] + 2 * x[8] + x[9] - 1,
        ],
    ),
    Case(
        name="HS113", start=(2, 3, 5, 5, 1, 2, 7, 3, 6, 10), best=24.3062091 + 31, least=hs113_rows,
        squares=lambda *x: [
            x[0] + 0.5 * x[1] - 7, math.sqrt(0.75) * (x[1] - 6), x[2] - 10, 2 * (x[3] - 5), x[4] - 3,
            ROOT2 * (x[5] - 1), math.sqrt(5) * x[6], math.sqrt(7) * (x[7] - 11), ROOT2 * (x[8] - 10), x[9] - 7,
        ],
    ),
    Case(
        name="HS268", start=(1, 1, 1, 1, 1), best=0.0,
        squares=lambda *x: [dot(row, x) - d for row, d in zip(HS268_D, HS268_RIGHT, strict=True)],
        least=lambda *x: [
            5 - sum(x[1:], x[0]), dot([10, 10, -3, 5, 4], x) - 20, dot([-8, 1, -2, -5, 3], x) + 40,
            dot([8, -1, 2, 5, -3], x) - 11, dot([-4, -2, 3, -5, 1], x) + 30,
        ],
    ),
]  # fmt: skip
