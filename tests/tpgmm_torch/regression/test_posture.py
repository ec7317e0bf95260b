"""The wanted posture minimises the fused cost within limits, and then nothing moves."""

import pytest
import torch

from tests.support.skills import bottle_demonstrations, generator, small_bottle
from tpgmm_torch import Frame
from tpgmm_torch.regression.posture import PostureCost, descend

# shortly before the grasp, where one component has nearly all the weight
TIME = torch.tensor(4.4, dtype=torch.float64)
REACHED = bottle_demonstrations()[0].frames["bottle"]
HIGH = Frame(torch.tensor([0.28, 0.0, 0.4], dtype=torch.float64))


def limits():
    robot = small_bottle().kinematics_
    return robot.lower, robot.upper


def searched(frame, start, ticks, time=TIME, asked=True, **options):
    """What is wanted at each tick, of a robot that is where it wants to be at once."""
    regression, found = small_bottle().skill, []
    search = regression.posture_search()
    asked = torch.full(start.shape[:-1], asked)
    for _ in range(ticks):
        estimate = regression.estimate(time, start, {"bottle": frame}, limits())
        start, search = search.advance(
            time, start, {"bottle": frame}, estimate, limits(), asked, **options
        )
        found.append(start)
    return found, search


def costs(frame, joints, time=TIME):
    """The cost of joints (P, A, N, n)."""
    regression, frames = small_bottle().skill, {"bottle": frame.expand(joints.shape[:1])}
    activation = regression.estimate(time, joints, frames).activation.expand(len(joints), -1)
    search, state = regression.posture_search(), regression.kinematics.state
    return PostureCost(search, activation, time, joints, frames, state)


def neutral():
    return generator().neutral_posture()


@pytest.mark.parametrize("frame", [REACHED, HIGH], ids=["reached", "high"])
def test_the_gradient_is_that_of_the_cost(frame):
    torch.manual_seed(0)
    joints = neutral() + 0.3 * torch.randn(1, 17, dtype=torch.float64)
    cost = costs(frame, joints)
    steps = 1e-6 * torch.eye(17, dtype=torch.float64).reshape(17, 1, 1, 17)
    every = torch.cat((joints[None, None], joints + steps, joints - steps))
    heights, downhill, precision = cost(every)
    slope = (heights[1:18] - heights[18:]).squeeze() / 2e-6
    assert float((slope + downhill[0].squeeze()).abs().max() / downhill[0].abs().max()) < 1e-6
    assert bool((torch.linalg.eigvalsh(precision[0]) > 0).all())


def test_who_is_not_asked_keeps_the_estimate():
    regression = small_bottle().skill
    estimate = regression.estimate(TIME, neutral(), {"bottle": HIGH}, limits())
    wanted, search = regression.posture_search().advance(
        TIME, neutral(), {"bottle": HIGH}, estimate, limits(), torch.tensor(False)
    )
    assert wanted is estimate.joints and search.active is None


def test_what_is_reached_is_left_to_the_regression():
    regression, joints = small_bottle().skill, neutral()
    for _ in range(30):
        joints = regression.estimate(TIME, joints, {"bottle": REACHED}, limits()).joints
    near = joints + 0.001
    found, search = searched(REACHED, near, 1, asked=False)
    assert torch.equal(found[0], regression.estimate(TIME, near, {"bottle": REACHED}).joints)
    assert search.active is None
    # a search that was begun ends there
    found, search = searched(REACHED, near, 3)
    assert float((found[-1] - joints).abs().max()) < 1e-3
    estimate = regression.estimate(TIME, near, {"bottle": REACHED}, limits())
    begun = regression.posture_search()
    for asked in (True, False):
        wanted, begun = begun.advance(
            TIME, near, {"bottle": REACHED}, estimate, limits(), torch.tensor(asked)
        )
    assert torch.equal(wanted, estimate.joints) and not bool(begun.active)


@pytest.mark.parametrize(
    "place",
    [[0.28, 0.0, 0.4], [0.12, 0.11, 0.55], [0.3, 0.1, 0.5], [0.2, -0.2, 0.5], [0.5, 0.0, 0.3]],
)
def test_what_cannot_be_reached_is_approached_and_then_nothing_moves(place):
    frame = Frame(torch.tensor(place, dtype=torch.float64))
    found, search = searched(frame, neutral(), 500)
    lower, upper = limits()
    assert all(bool(((q >= lower) & (q <= upper)).all()) for q in found)
    assert float((found[-1] - found[-6]).abs().max()) < 1e-4
    assert bool(search.active)
    # the best of many starts, within 5 % of its distance
    generator = torch.Generator().manual_seed(1)
    many = torch.rand(60, 17, generator=generator, dtype=torch.float64)
    many = (lower + (upper - lower) * many).expand(2, 1, -1, -1)
    cost, damping = costs(frame, many[0, 0]), torch.zeros(1, 60, dtype=torch.float64)
    for _ in range(80):
        many, damping, height = descend(cost, many, damping, lower, upper)
    here = float(costs(frame, found[-1][None])(found[-1][None, None, None])[0])
    assert here <= 1.05**2 * float(height.min())


def test_between_two_components_what_cannot_be_reached_is_approached_too():
    frame = Frame(torch.tensor([0.3, 0.1, 0.5], dtype=torch.float64))
    times = torch.linspace(3, 5, 201, dtype=torch.float64)
    regression = small_bottle().skill
    shares = torch.stack(
        [regression.estimate(t, neutral(), {"bottle": frame}).activation for t in times]
    )
    time = times[shares.amax(-1).argmin()]
    assert float(shares.amax(-1).min()) < 0.7
    [*_, here], _ = searched(frame, neutral(), 350, time)
    cost = costs(frame, here[None], time)
    joints, damping = here.expand(2, 1, 1, -1), torch.zeros(1, 1, dtype=torch.float64)
    for _ in range(80):
        joints, damping, height = descend(cost, joints, damping, *limits())
    assert float(cost(here[None, None, None])[0]) <= 1.02**2 * float(height)


def test_a_robot_does_not_depend_on_its_batch():
    places = torch.tensor([[0.28, 0, 0.4], [0.28, 0, 0.15], [0.1, 0, -0.2]]).double()
    starts = torch.stack([neutral(), neutral() + 0.02, neutral() - 0.05])
    together, search = searched(Frame(places), starts, 12)
    assert search.active.shape == (3,)
    for robot in range(3):
        alone, _ = searched(Frame(places[robot]), starts[robot], 12)
        for one, both in zip(alone, together, strict=True):
            assert float((one - both[robot]).abs().max()) < 1e-9


def test_states_may_be_given():
    given, _ = searched(HIGH, neutral(), 3, state_at=small_bottle().kinematics_.state)
    plain, _ = searched(HIGH, neutral(), 3)
    assert all(torch.equal(one, other) for one, other in zip(given, plain, strict=True))


def test_a_search_that_ended_begins_where_the_robot_is():
    start = torch.stack((neutral(), neutral() + 0.05))
    _, search = searched(REACHED, start, 3)
    elsewhere = start - 0.2
    one = search.drop_robots(torch.tensor([True, False]))
    assert one.active is not None and one.active.tolist() == [False, True]
    regression = small_bottle().skill
    estimate = regression.estimate(TIME, elsewhere, {"bottle": REACHED}, limits())
    asked = torch.ones(2, dtype=torch.bool)
    steps = [
        before.advance(TIME, elsewhere, {"bottle": REACHED}, estimate, limits(), asked)[0]
        for before in (one, regression.posture_search(), search)
    ]
    torch.testing.assert_close(steps[0][0], steps[1][0], rtol=0, atol=1e-12)
    torch.testing.assert_close(steps[0][1], steps[2][1], rtol=0, atol=1e-12)
    assert float((steps[0][0] - steps[2][0]).abs().max()) > 1e-3
    assert search.drop_robots(asked).active is None
    assert search.reset().drop_robots(asked).active is None
