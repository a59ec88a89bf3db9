"""The end of scenarios/cubesat.json and of the scene in tests/it/orbit.rs, by formulas of their own and DOP853 of SciPy.

    python3 docs/cubesat.py FILE.json [FILE.json ...]

prints the attitude, row by row, and the body momentum. Needs numpy and scipy (1.17 was used).
"""

import json
import sys

import numpy as np
from scipy.integrate import solve_ivp


def turn(axis, angle):
    """The rotation about an axis by an angle (Rodrigues)."""
    x = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def place_and_velocity(orbit, t):
    """Place and velocity on a Kepler orbit whose node drifts by J2, in m and m/s."""
    a, n, e = orbit["semi_major_axis_m"], orbit["mean_motion_rad_s"], orbit.get("eccentricity", 0.0)
    i, drift = orbit.get("inclination_rad", 0.0), 0.0
    if "j2" in orbit:
        p = a * (1 - e * e)
        drift = -1.5 * n * orbit["j2"]["j2"] * (orbit["j2"]["equatorial_radius_m"] / p) ** 2 * np.cos(i)
    mean = orbit.get("mean_anomaly_rad", 0.0) + n * t
    anomaly = mean
    for _ in range(60):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
    rate = n / (1 - e * np.cos(anomaly))
    b = a * np.sqrt(1 - e * e)
    flat = np.array([a * (np.cos(anomaly) - e), b * np.sin(anomaly), 0.0])
    flat_rate = np.array([-a * np.sin(anomaly), b * np.cos(anomaly), 0.0]) * rate
    z = [0, 0, 1]
    plane = turn(z, orbit.get("node_rad", 0.0) + drift * t) @ turn([1, 0, 0], i) @ turn(z, orbit.get("argument_rad", 0.0))
    place = plane @ flat
    return place, plane @ flat_rate + np.cross([0, 0, drift], place)


def field(dipole, place, t):
    """The field of a tilted dipole that turns, in T."""
    tilt, angle = dipole.get("tilt_rad", 0.0), dipole.get("rotation_rad_s", 0.0) * t
    d = -np.array([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.cos(tilt)])
    r = np.linalg.norm(place)
    x = place / r
    return dipole["moment_t_m3"] / r**3 * (3 * (d @ x) * x - d)


def factor(given, t):
    """A harmonic factor."""
    if given is None:
        return 1.0
    harmonic = given["harmonic"]
    phase = harmonic.get("phase_rad", 0.0)
    return harmonic.get("mean", 1.0) + harmonic["amplitude"] * np.cos(harmonic["rate_rad_s"] * t + phase)


def torque(scene, g, t):
    """The torque on the body, in its coordinates."""
    dipole = scene["field"]["dipole"]
    place, velocity = place_and_velocity(dipole["orbit"], t)
    moment = np.array(dipole.get("permanent_moment_a_m2", [0, 0, 0]), float)
    total = np.cross(moment, g.T @ field(dipole, place, t))
    for given in scene.get("torques", []):
        for kind, what in given.items():
            for face in what["faces"]:
                n = np.array(face["normal"], float)
                n /= np.linalg.norm(n)
                centre, area = np.array(face["centre_m"], float), face["area_m2"]
                if kind == "drag":
                    v = g.T @ velocity
                    cosine = n @ v / np.linalg.norm(v)
                    density = what["density_kg_m3"] * factor(what.get("factor"), t)
                    force = -0.5 * density * face["coefficient"] * area * cosine * np.linalg.norm(v) * v
                else:
                    s = g.T @ np.array(what["sun"], float)
                    s /= np.linalg.norm(s)
                    cosine = n @ s
                    pressure = what["pressure_n_m2"] * factor(what.get("factor"), t)
                    force = -pressure * area * cosine * (
                        (1 - face["specular"]) * s + 2 * (face["specular"] * cosine + face["diffuse"] / 3) * n
                    )
                if cosine > 0:
                    total = total + np.cross(centre, force)
    return total


def end(scenario):
    """Attitude and body momentum at the end."""
    scene = scenario["scene"]
    inertia = np.array(scene["inertia"]["principal"])
    start = scene["initial"]
    g = np.eye(3)
    if "attitude" in start:
        given = start["attitude"]["axis_angle"]
        g = turn(given["axis"], np.radians(given["angle_deg"]))
    mu = inertia * np.array(start["angular_velocity"]["body"])

    def rates(t, state):
        g, mu = state[:9].reshape(3, 3), state[9:]
        w = mu / inertia
        hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(g @ hat).ravel(), np.cross(mu, w) + torque(scene, g, t)])

    state = np.concatenate([g.ravel(), mu])
    # A kink in the torque is resolved by short steps alone.
    found = solve_ivp(
        rates, (0, scenario["duration_s"]), state, method="DOP853", rtol=1e-13, atol=1e-15, max_step=5.0
    )
    return found.y[:9, -1].reshape(3, 3), found.y[9:, -1]


if __name__ == "__main__":
    for path in sys.argv[1:]:
        with open(path, encoding="utf-8") as file:
            attitude, momentum = end(json.load(file))
        print(json.dumps([[float(x) for x in row] for row in attitude]))
        print(json.dumps([float(x) for x in momentum]))
