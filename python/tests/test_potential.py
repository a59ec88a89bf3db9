"""A potential that Python computes: the motion of the built-in term, and what is said of mistakes."""

import numpy as np
import pytest

import vpdsim as vpd

POINT = np.array([0.1, -0.2, 0.4])


class Weight:
    """U = weight <e_n, g point>: the term `uniform`."""

    def __init__(self, weight, point):
        self.weight, self.point, self.calls, self.most = weight, np.asarray(point), 0, 0

    def energy(self, g):
        return self.weight * (g @ self.point)[:, -1]

    def gradient(self, g):
        self.calls += 1
        self.most = max(self.most, len(g))
        gradient = np.zeros_like(g)
        gradient[:, -1] = self.weight * self.point
        return gradient


def top(weight, **more):
    term = {"kind": "uniform", "weight": weight, "body_point": list(POINT), "direction": [0, 0, 1]}
    return {
        "name": "top", "step_s": 0.01, "steps": 1000, "log": {"every": 10},
        "scene": {
            "inertia": {"principal": [1.0, 1.2, 0.8]},
            "potential": [term] if weight else [],
            "initial": {"angular_velocity": {"body": [0.2, 0.1, 2.0]}},
        },
        **more,
    }


@pytest.mark.parametrize("tableau", ["gauss1", "gauss2", "gauss4"])
def test_the_motion_is_that_of_the_built_in_term(tableau):
    method = {"method": {"name": "vpd", "tableau": tableau}}
    built_in = vpd.run(top(2.0, **method))
    law = Weight(2.0, POINT)
    own = vpd.run(top(0.0, **method), potential=law)
    # All stages of a round in one call.
    assert law.calls > 1000
    assert law.most >= int(tableau[-1])
    assert np.abs(own.attitude - built_in.attitude).max() < 1e-13
    assert np.abs(own.body_momentum - built_in.body_momentum).max() < 1e-13
    assert np.abs(own.energy.total - built_in.energy.total).max() < 1e-13
    # Next to a term, half of it each.
    both = vpd.run(top(1.0, **method), potential=Weight(1.0, POINT))
    assert np.abs(both.attitude - built_in.attitude).max() < 1e-13


def test_a_body_at_rest_is_set_off_and_four_dimensions_work():
    still = top(0.0)
    del still["scene"]["initial"]
    assert np.linalg.norm(vpd.run(still, potential=Weight(1.0, POINT)).angular_velocity[-1]) > 0.1
    four = {
        "name": "four", "step_s": 0.01, "steps": 200,
        "scene": {"inertia": {"second_moments": [0.4, 0.7, 1.0, 1.3]}},
    }
    point = [0.1, 0.2, 0.3, 0.4]
    law = Weight(1.5, point)
    own = vpd.run(four, potential=law)
    assert law.most >= 2
    four["scene"]["potential"] = [{"kind": "uniform", "weight": 1.5, "body_point": point, "direction": [0, 0, 0, 1]}]
    assert np.abs(own.attitude - vpd.run(four).attitude).max() < 1e-13


def test_a_log_is_kept_and_read(tmp_path):
    log = tmp_path / "own.mcap"
    run = vpd.run(top(0.0), potential=Weight(1.0, POINT), log=log)
    assert np.array_equal(vpd.read(log).attitude, run.attitude)
    with pytest.raises(vpd.Error, match="own.mcap"):
        vpd.verify(log)
    with pytest.raises(vpd.Error, match="exists"):
        vpd.run(top(0.0), potential=Weight(1.0, POINT), log=log)


def test_mistakes_are_named():
    class Wrong(Weight):
        def gradient(self, g):
            return -super().gradient(g)

    with pytest.raises(vpd.Error, match="gradient of the potential differs"):
        vpd.run(top(0.0), potential=Wrong(1.0, POINT))

    class Short(Weight):
        def gradient(self, g):
            return [1.0, 2.0, 3.0]

    with pytest.raises((ValueError, TypeError)):
        vpd.run(top(0.0), potential=Short(1.0, POINT))

    class Late(Weight):
        def gradient(self, g):
            if self.calls > 500:
                raise RuntimeError("no more")
            return super().gradient(g)

    with pytest.raises(RuntimeError, match="no more"):
        vpd.run(top(0.0), potential=Late(1.0, POINT))
    with pytest.raises(AttributeError):
        vpd.run(top(0.0), potential=object())
    for change, pointer in [
        ({"/method": {"name": "rk_projected"}}, "/method/name"),
        ({"/scene/torques": [{"constant": {"body": [0, 0, 1]}}]}, "/scene"),
        ({"/derivatives": {"state": True}}, "/derivatives"),
        ({"/ensemble": {"members": 3, "seed": 1, "attitude_spread_rad": 0.1}}, "/ensemble"),
    ]:
        with pytest.raises(vpd.ScenarioError) as refused:
            vpd.run(top(0.0), set=change, potential=Weight(1.0, POINT))
        assert refused.value.pointer == pointer


def test_a_step_that_fails_keeps_the_run_so_far():
    class Hole(Weight):
        def gradient(self, g):
            return np.full_like(g, np.nan) if self.calls > 500 else super().gradient(g)

    with pytest.raises(vpd.RunFailed) as failed:
        vpd.run(top(0.0), potential=Hole(1.0, POINT))
    assert failed.value.step > 10
    assert len(failed.value.run.time) > 1
