"""The known ends of solve/tests/it/bodies.rs, to 22 digits, by programs that share nothing with it.

    python3 -m venv venv && venv/bin/pip install heyoka==7.13.2 mpmath==1.4.1 numpy scipy
    venv/bin/python docs/known.py

1. The planar double pendulum: Lagrange's equations of two angles.
2. Three links that hang on each other and swing in space: the equations of docs/chain.py, Newton's and Euler's with the forces in the
   joints as unknowns.
3. The binary asteroid of scenarios/binary-asteroid.json: its energy in the vector from one centre to the other and two angles,
   differentiated by heyoka. Then the periods in it, fitted over 400,000 s, next to those of linear theory: small deviations from the
   circle on which the moon points to a primary with equal moments in the plane.

Each is computed by heyoka's Taylor series with 40 digits and with 50, which have to agree in 25. Numbers of a scene are the doubles
that the test has.
"""

import json
from pathlib import Path

import heyoka as hy
import mpmath as mp
import numpy as np
from scipy.optimize import least_squares

from chain import Chain, rotation, system

# Decimal digits, and the bits that hold them.
PRECISIONS = [(40, 136), (50, 170)]


def agreed(values):
    """What all computations of a list of numbers agree on, to 22 digits."""
    for one, *others in zip(*values):
        assert all(abs(one - other) < mp.mpf(10) ** -25 for other in others), (one, others)
    return [mp.nstr(one, 22) for one in values[0]]


def taylor(equations, start, seconds, bits):
    """The state at the end by heyoka, as numbers of mpmath."""
    real = lambda x: hy.real(mp.nstr(mp.mpf(x), mp.mp.dps), bits)
    series = hy.taylor_adaptive(equations, [real(x) for x in start], fp_type=hy.real, prec=bits, compact_mode=True)
    series.propagate_until(real(seconds))
    return [mp.mpf(str(x)) for x in series.state]


def double_pendulum(bits):
    """(q1, q2, q1', q2') at 2 s, of links about the x axis, the second behind the whole length of the first."""
    (m1, m2), l, c, (j1, j2), g = (1.2, 0.7), 0.8, 0.4, (0.06, 0.05), 9.81
    a11, a22 = j1 + m1 * c * c + m2 * l * l, j2 + m2 * c * c
    q1, q2, w1, w2 = variables = hy.make_vars("q1", "q2", "w1", "w2")
    a12, bend = m2 * l * c * hy.cos(q1 - q2), m2 * l * c * hy.sin(q1 - q2)
    f1 = -bend * w2 * w2 - (m1 * c + m2 * l) * g * hy.sin(q1)
    f2 = bend * w1 * w1 - m2 * c * g * hy.sin(q2)
    det = a11 * a22 - a12 * a12
    rates = [w1, w2, (a22 * f1 - a12 * f2) / det, (a11 * f2 - a12 * f1) / det]
    return taylor(list(zip(variables, rates)), [0.9, 0.3, 0.4, -1.1], 2, bits)


def links(bits):
    """The rows of the three attitudes at 1 s, then the angular velocities in the bodies."""
    half, moments = np.array([0.0, 0.0, 0.5]), np.array([0.012 + 0.08, 0.01 + 0.08, 0.01 + 0.012])
    chain = Chain([1.0] * 3, [moments] * 3, [half] * 3, [-half] * 2, np.array([0.0, 0.0, 1.0]), 9.81)
    start = []
    for a in range(3):
        turn = [mp.mpf(0.6 + 0.2 * a), mp.mpf(0.1 * a), mp.mpf(0)]
        angle = mp.sqrt(sum(x * x for x in turn))
        start += [mp.cos(angle / 2), *(mp.sin(angle / 2) * x / angle for x in turn)]
        start += [0.3, 0.5 - 0.1 * a, 0.4 * a]
    end = taylor(system(chain), start, 1.0, bits)
    rows = [x for a in range(3) for x in rotation(end[7 * a : 7 * a + 4]).ravel()]
    return rows + [x for a in range(3) for x in end[7 * a + 4 : 7 * a + 7]]


ASTEROID = json.loads((Path(__file__).parent.parent / "scenarios/binary-asteroid.json").read_text())["scene"]
BODIES = ASTEROID["bodies"]
MASSES = [body["mass"] for body in BODIES]
MOMENTS = [body["inertia"]["principal"] for body in BODIES]
REDUCED_MASS = MASSES[0] * MASSES[1] / (MASSES[0] + MASSES[1])


def potential(r, seen, moments=MOMENTS):
    """Of the distance, and for each body the squares of the direction to the other along its first and second axis."""
    constant = ASTEROID["potential"][0]["constant"]
    found = -constant * MASSES[0] * MASSES[1] / r
    for (a, b, c), (along, across), other in zip(moments, seen, reversed(MASSES)):
        found -= constant * other * (a + b + c - 3 * (a * along + b * across)) / (2 * r * r * r)
    return found


def asteroid():
    """The equations of (x, y, turn of the primary, turn of the moon) and their rates, x, y from the primary to the moon; the start."""
    x, y, *turns = places = hy.make_vars("x", "y", "a", "b")
    r = hy.sqrt(x * x + y * y)
    along = [(hy.cos(turn) * x + hy.sin(turn) * y) / r for turn in turns]
    across = [(hy.cos(turn) * y - hy.sin(turn) * x) / r for turn in turns]
    energy = potential(r, [(p * p, q * q) for p, q in zip(along, across)])
    rates = hy.make_vars("u", "v", "p", "q")
    inertia = [REDUCED_MASS, REDUCED_MASS, *(moments[2] for moments in MOMENTS)]
    equations = list(zip(places, rates)) + [(rate, -hy.diff(energy, q) / J) for q, rate, J in zip(places, rates, inertia)]
    apart = lambda key: [mp.mpf(float(b)) - mp.mpf(float(a)) for a, b in zip(*(body["initial"][key] for body in BODIES))][:2]
    spins = [body["initial"]["angular_velocity"]["body"][2] for body in BODIES]
    angle = BODIES[1]["initial"]["attitude"]["axis_angle"]["angle_rad"]
    return equations, [*apart("position"), 0, angle, *apart("velocity"), *spins]


def fitted_periods():
    """Of a revolution, and of two waves in the angle from the line between the centres to the moon's axis, in h; mean distance in km."""
    equations, start = asteroid()
    series = hy.taylor_adaptive(equations, [float(x) for x in start])
    times = np.arange(0.0, 400_001.0, 100.0)
    x, y, _, turn = series.propagate_grid(times)[-1][:, :4].T
    line = np.unwrap(np.arctan2(y, x))
    rate = line[-1] / times[-1]

    def off(frequencies):
        waves = [wave(f * rate * times) for f in frequencies for wave in (np.cos, np.sin)]
        table = np.column_stack([np.ones_like(times), *waves])
        return table @ np.linalg.lstsq(table, turn - line, rcond=None)[0] - (turn - line)

    return [2 * np.pi / w / 3600 for w in (rate, *(rate * least_squares(off, [0.85, 1.0]).x))], (np.hypot(x, y).max() + np.hypot(x, y).min()) / 2


def linear_periods(r):
    """The same by linear theory, at a distance r."""
    (a1, b1, c1), (a, b, c) = MOMENTS
    even = [((a1 + b1) / 2, (a1 + b1) / 2, c1), (a, b, c)]
    of = lambda r, phi: potential(r, [(1.0, 0.0), (np.cos(phi) ** 2, np.sin(phi) ** 2)], even)
    slope = lambda f, x, by: (8 * (f(x + by) - f(x - by)) - f(x + 2 * by) + f(x - 2 * by)) / (12 * by)

    def rate(s):
        r, phi, radial, turning, spin = s
        torque = slope(lambda phi: of(r, phi), phi, 1e-3)
        pull = slope(lambda r: of(r, phi), r, 1e-3)
        around = (torque / REDUCED_MASS - 2 * r * radial * turning) / r**2
        return np.array([radial, spin - turning, r * turning**2 - pull / REDUCED_MASS, around, -torque / c])

    turning = np.sqrt(slope(lambda r: of(r, 0.0), r, 1e-3) / (REDUCED_MASS * r))
    rest, by = np.array([r, 0.0, 0.0, turning, turning]), np.array([1e-4, 1e-4, 1e-8, 1e-8, 1e-8])
    matrix = np.column_stack([(rate(rest + step) - rate(rest - step)) / (2 * step.max()) for step in np.diag(by)])
    waves = sorted({round(abs(x.imag), 12) for x in np.linalg.eigvals(matrix) if abs(x.imag) > 1e-6})
    return [2 * np.pi / w / 3600 for w in (turning, *waves)]


def main():
    found = {"double pendulum, q1 q2 w1 w2": [], "three links, rows of attitudes, then rates": [], "asteroid, x y a b and rates": []}
    for digits, bits in PRECISIONS:
        mp.mp.dps = digits
        for name, values in zip(found, (double_pendulum(bits), links(bits), taylor(*asteroid(), 100_000, bits))):
            found[name].append(values)
    for name, values in found.items():
        print(name)
        for number in agreed(values):
            print("   ", number)
    words = lambda hours: ", ".join(f"{x:.3f}" for x in hours)
    fitted, r = fitted_periods()
    print(f"asteroid, h: revolution and two waves {words(fitted)}; by linear theory at {r:.4f} km {words(linear_periods(r))}")


if __name__ == "__main__":
    main()
