"""The solver against an exhaustive search that shares no code with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers import brute_force
from helpers.easy_task import WORKSHOP
from helpers.paths import ROOT
from helpers.refusal import assert_refused
from trap_tube_jax.dynamics import replay
from trap_tube_jax.objects import EXIT, MAX_STEPS, NUM_ACTIONS, TOOL, TRAP, TUBE1, TUBE2
from trap_tube_jax.positions import NUM_POSITIONS
from trap_tube_jax.scoring.knowledge import first_push
from trap_tube_jax.solver.search import levels, validate_on_host
from trap_tube_jax.state import take
from trap_tube_jax.transfers import swap_with_tool

NUM_ROOMS = 30
NUM_DRAWN = 16  # tasks of a set

WALLED_IN = [
    *(".1..........", "A1..........", "11..........", "............"),
    *("....1111....", ".T..xF.e....", ".T..x..e....", ".T..2222...."),
    *["............"] * 4,
]
MAZE = [
    "A...........",
    *["11111111111.", "............", ".11111111111", "............"] * 2,
    *("11111111111.", ".....T......", "F..........."),
]


def random_room(seed: int) -> tt.State:
    """A room of 3 x 4 cells in a corner of the board, with anything anywhere in it."""
    rng = np.random.default_rng(seed)
    board = np.full((12, 12), TUBE1)
    room = rng.choice([0, TUBE2, TRAP, EXIT], size=(3, 4), p=[0.7, 0.1, 0.08, 0.12])
    board[:3, :4] = room
    ground = np.argwhere(board == 0)
    food_cells = np.argwhere((board == 0) | (board == EXIT))
    agent = rng.choice(ground)
    food = rng.choice([cell for cell in food_cells if (cell != agent).any()])
    extent = rng.permutation(np.array([1, rng.integers(1, 4)]))
    return tt.State.create(
        board=board, agent=agent, food=food, tool=rng.integers(0, (3, 4)), tool_extent=extent
    )


@pytest.fixture(scope="module")
def rooms() -> list[tt.State]:
    return [random_room(seed) for seed in range(NUM_ROOMS)]


@pytest.fixture(scope="module")
def room_plans(rooms) -> tt.Plan:
    return tt.solve_batch(stack(rooms))


@pytest.fixture(scope="module")
def workshop() -> tt.State:
    return WORKSHOP


@pytest.fixture(scope="module")
def workshop_distances(workshop) -> np.ndarray:
    return tt.distances(workshop)


@pytest.fixture(scope="module")
def base_plan() -> tt.Plan:
    return tt.solve(tt.base_state())


def stack(states: list[tt.State]) -> tt.State:
    return jax.tree.map(lambda *fields: jnp.stack(fields), *states)


@jax.jit
@jax.vmap
def play(state: tt.State, actions: jax.Array) -> tuple[tt.State, jax.Array]:
    """The last states, and what `Environment.step` pays for plans i32[B, L, 2]: f32[B, L]."""

    def step(state, action):
        state, timestep = env.step(state, action)
        return state, timestep.reward

    env = tt.make("base")
    return jax.lax.scan(step, state, actions)


def assert_paid_exactly_at_the_end(states: tt.State, plans: tt.Plan):
    _, rewards = play(states, plans.actions)
    expected = np.arange(1, rewards.shape[1] + 1) == plans.length[:, None]
    np.testing.assert_array_equal(rewards, expected)


@pytest.mark.parametrize(
    ("code", "length"), [(TOOL, 11), (TUBE1, 10), (TUBE2, 8), (TRAP, 10), (EXIT, 16)]
)
def test_symbolic_tasks_have_the_known_plan_lengths(code, length):
    state = swap_with_tool(tt.base_state(), jnp.int32(code))
    plan = tt.solve(state)
    assert (plan.length, plan.solvable, plan.actions.shape) == (length, True, (length, 2))
    if code in (TOOL, TUBE2):
        found = brute_force.levels(state)
        assert next(time for time, level in enumerate(found, 1) if level.solved.any()) == length


@pytest.mark.parametrize(
    ("name", "mean", "standard_deviation"), [("p", 22.7, 6), ("pstsy", 12.5, 7)]
)
def test_tasks_of_a_set_are_as_long_as_published_and_pay_at_the_plans_end(
    name, mean, standard_deviation
):
    keys = jax.random.split(jax.random.key(0), NUM_DRAWN)
    states, _ = jax.jit(jax.vmap(tt.make(name).reset))(keys)
    plans = tt.solve_batch(states)
    assert plans.solvable.all()
    assert abs(plans.length.mean() - mean) < 4 * standard_deviation / np.sqrt(NUM_DRAWN)
    assert plans.length.max() <= MAX_STEPS
    assert_paid_exactly_at_the_end(states, plans)


@pytest.mark.slow
def test_as_few_plans_of_psy_move_the_food_as_the_readme_says():
    tasks = tt.evaluation_tasks("psy", 1000)
    pushes = jax.vmap(first_push)(tasks, tt.solve_batch(tasks).actions)
    assert np.asarray(pushes).any(axis=-1).sum() == 202


@pytest.mark.slow
def test_random_actions_solve_the_base_task_as_rarely_as_environment_md_says():
    """The exact probability, over the graph of all states that can be reached."""
    found = list(levels(validate_on_host(tt.base_state())))
    nodes, successors, solved = (
        np.concatenate([getattr(level, name) for level in found])
        for name in ("nodes", "successors", "solved")
    )
    place = np.zeros(NUM_POSITIONS, np.int32)
    place[nodes] = np.arange(len(nodes))
    following = place[successors][~solved]
    probability = np.eye(1, len(nodes))[0]
    total = 0.0
    for _ in range(MAX_STEPS):
        share = np.broadcast_to(probability[:, None] / NUM_ACTIONS, successors.shape)
        total += share[solved].sum()
        probability = np.bincount(following, share[~solved], len(nodes))
    np.testing.assert_allclose(total + probability.sum(), 1)
    page = ROOT / "trap_tube_jax" / "environment.md"
    assert f"in {1e6 * total:.2f} of 1,000,000 episodes" in page.read_text()


def test_plans_equal_brute_forces_alone_and_in_a_batch(rooms, room_plans):
    longest = room_plans.length.max()
    assert room_plans.actions.shape == (NUM_ROOMS, longest, 2)
    for index, room in enumerate(rooms):
        expected = brute_force.first_plan(room)
        for plan in (take(room_plans, index), *([tt.solve(room)] if index % 5 == 0 else [])):
            dtypes = [field.dtype for field in (plan.actions, plan.length, plan.solvable)]
            assert dtypes == [np.int32, np.int32, np.bool_]
            assert plan.solvable == (expected is not None), f"room {index}"
            assert plan.length == (-1 if expected is None else len(expected))
            steps = max(int(plan.length), 0)
            assert plan.actions[:steps].tolist() == (expected or [])
            assert (plan.actions[steps:] == -1).all()
    assert 5 < room_plans.solvable.sum() < NUM_ROOMS - 5
    end, _ = play(stack(rooms), room_plans.actions)
    uses_tool = (end.tool != stack(rooms).tool).any(axis=1) & room_plans.solvable
    assert uses_tool.sum() >= 3
    assert_paid_exactly_at_the_end(stack(rooms), room_plans)


@pytest.mark.parametrize(
    "change",
    [
        {"board": np.array([[0] * 5, [0, 0, TUBE1, 0, 0], [0] * 5])},
        {"tool_extent": (2, 1)},
        {"food": (0, 4)},
        {"tool": (1, 2)},
        {"agent": (0, 0)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_tasks_of_a_batch_that_differ_in_one_field_have_different_plans(change):
    parts = {"agent": (1, 0), "food": (1, 4), "tool": (0, 2), "tool_extent": (1, 1)}
    board = np.full((12, 12), TUBE1)
    states = []
    for changed in ({}, change):
        fields = {"board": np.zeros((3, 5)), **parts, **changed}
        board[:3, :5] = fields.pop("board")
        states.append(tt.State.create(board=board.copy(), **fields))
    one, other = map(tt.solve, states)
    assert one.actions.tolist() != other.actions.tolist()
    plans = tt.solve_batch(stack(states))
    for index, plan in enumerate((one, other)):
        found = take(plans, index)
        np.testing.assert_array_equal(found.actions[: found.length], plan.actions)


def test_plans_do_not_depend_on_colours(base_plan):
    base = tt.base_state()
    plans = tt.solve_batch(stack([base, base.replace(palette=base.palette[::-1])]))
    expected = base_plan.actions
    for actions in (tt.solve(tt.base_state(1)).actions, *plans.actions):
        np.testing.assert_array_equal(actions, expected)


def test_a_task_that_cannot_be_solved_has_an_empty_plan():
    state = tt.State.from_ascii(WALLED_IN)
    plan = tt.solve(state)
    assert (plan.length, plan.solvable, plan.actions.shape) == (-1, False, (0, 2))
    plans = tt.solve_batch(stack([state]))
    assert plans.actions.shape == (1, 0, 2)
    assert (tt.distances(state) == -1).all()


def test_plans_are_not_bound_by_the_step_limit():
    assert tt.solve(tt.State.from_ascii(MAZE)).length == 6 * 11 + 11


def test_a_task_is_solved_from_the_middle_of_an_episode(base_plan):
    env = tt.make("base")
    state = tt.base_state()
    for action in base_plan.actions[:4]:
        state, _ = env.step(state, action)
    np.testing.assert_array_equal(tt.solve(state).actions, base_plan.actions[4:])


def test_distances_equal_brute_forces_and_count_down_along_the_plan(workshop, workshop_distances):
    expected = brute_force.graph(workshop)
    assert workshop_distances.dtype == np.int16
    index = np.stack(np.divmod(expected.positions[:, [2, 1, 0]], 12), axis=-1).reshape(-1, 6).T
    to_goal = np.where(np.isinf(expected.to_goal), -1, expected.to_goal)
    np.testing.assert_array_equal(workshop_distances[tuple(index)], to_goal)
    assert np.count_nonzero(workshop_distances >= 0) == np.count_nonzero(to_goal >= 0)
    plan = tt.solve(workshop)
    states = replay(workshop, plan.actions)
    cells = np.concatenate([states.food, states.tool, states.agent], axis=1)
    assert workshop_distances[tuple(cells.T)].tolist() == list(range(plan.length, -1, -1))


def test_finished_and_invalid_states_are_refused():
    base = tt.base_state()
    solved = base.replace(agent=base.food, terminated=jnp.array(True))
    trapped = base.replace(agent=jnp.array([4, 4], jnp.int32))
    words = "state 1 of the batch: the state is terminated"
    assert_refused(["state is terminated"], tt.solve, solved)
    assert_refused(["state is truncated"], tt.distances, base.replace(truncated=jnp.array(True)))
    assert_refused(["agent at", "stands on tube1"], tt.solve, trapped)
    assert_refused(["expected a trap_tube_jax.State"], tt.solve, (1, 2))
    assert_refused(["runs on the host"], jax.jit(lambda state: tt.solve(state).length), base)
    assert_refused([words], tt.solve_batch, stack([base, solved]))
    assert_refused(["one leading axis"], tt.solve_batch, base)
    assert_refused(["must be"], tt.solve, stack([base, base]))
