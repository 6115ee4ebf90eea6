"""Faults of the environment for `mutation_check.py`, each with the tests that should see it."""

from typing import NamedTuple

# Of the exhaustive comparison the base task and its swaps are enough here.
STEP = ("tests/test_golden.py", "tests/test_dynamics.py", "-k", "not p-3 and not psy-3")
OBSERVE = ("tests/test_observation.py", "tests/test_golden.py")
TIME = (
    *("tests/test_environment.py", "tests/test_wrappers.py"),
    *("-k", "last_step or limit_trunc or larger or auto or statist"),
)
PERCEPTUAL = ("tests/test_transfers.py", "-k", "perceptual")
STRUCTURAL = ("tests/test_transfers.py", "-k", "structural")
SYMBOLIC = ("tests/test_transfers.py", "-k", "symbolic")
GRADED = ("tests/test_graded.py",)
COMPOSE = ("tests/test_transfers.py", "-k", "compose or then")


class Fault(NamedTuple):
    """A change of one place in one module, and the tests that should see it.

    Modules are those of `trap_tube_jax` unless they begin with `agents/`.
    """

    module: str
    description: str
    old: str
    new: str
    tests: tuple[str, ...]


ENVIRONMENT_FAULTS = (
    Fault(
        "dynamics",
        "the agent grasps from above the tool",
        "on_tool(state.agent + unit_vector(direction)) & ~on_tool(state.agent)",
        "on_tool(state.agent + unit_vector(direction))",
        STEP,
    ),
    Fault(
        "dynamics",
        "the agent walks into the trap",
        "static_object(board, agent + move) == GROUND",
        "static_object(board, agent + move) <= 1",
        STEP,
    ),
    Fault(
        "dynamics",
        "food is behind, not ahead",
        "on_tool(food - move)",
        "on_tool(food + move) ",
        STEP,
    ),
    Fault(
        "dynamics",
        "food under the tool is pushed by it",
        "on_tool(food - move) & ~on_tool(food)",
        "on_tool(food - move)",
        STEP,
    ),
    Fault("dynamics", "the exit blocks food", " | (beyond_food == EXIT)", "", STEP),
    Fault(
        "dynamics", "the trap lets food in", "(beyond_food == EXIT)", "(beyond_food <= EXIT)", STEP
    ),
    Fault(
        "dynamics",
        "food moves where the agent cannot",
        "food_moves = grasped & agent_free &",
        "food_moves = grasped &",
        STEP,
    ),
    Fault(
        "dynamics",
        "the tool's end leaves the board",
        " & is_on_board(tool + move + extent - 1)",
        "",
        STEP,
    ),
    Fault("dynamics", "the tool runs over food", "(~food_ahead | food_moves) & ", "", STEP),
    Fault(
        "dynamics",
        "the tool waits for moving food",
        "(~food_ahead | food_moves)",
        "~food_ahead",
        STEP,
    ),
    Fault(
        "dynamics",
        "the tool moves where the agent cannot",
        "tool_moves = grasped & agent_free &",
        "tool_moves = grasped &",
        STEP,
    ),
    Fault(
        "dynamics", "nothing holds the agent", "held = grasped & ~tool_moves", "held = False", STEP
    ),
    Fault(
        "dynamics",
        "the tool's old place blocks the agent",
        "bar_covers(new_tool, extent, agent + move)",
        "bar_covers(tool, extent, agent + move)",
        STEP,
    ),
    Fault(
        "dynamics",
        "food in the exit is out of reach",
        "(agent_free | reaches_food)",
        "agent_free",
        STEP,
    ),
    Fault(
        "dynamics",
        "success counts one step late",
        "same_cell(new_agent, new_food)",
        "same_cell(agent, food)",
        STEP,
    ),
    Fault(
        "dynamics",
        "a truncated episode goes on",
        "~(state.terminated | state.truncated)",
        "~state.terminated",
        ("tests/test_dynamics.py", "-k", "absorb"),
    ),
    Fault(
        "dynamics",
        "the board has no edge",
        ".astype(jnp.int32), -1)",
        ".astype(jnp.int32), 0)",
        STEP,
    ),
    Fault(
        "geometry",
        "left and right are swapped",
        "(direction == RIGHT).astype(jnp.int32) - (direction == LEFT)",
        "(direction == LEFT).astype(jnp.int32) - (direction == RIGHT)",
        STEP,
    ),
    Fault(
        "geometry",
        "a bar is one cell longer",
        "(cell < corner + extent)",
        "(cell <= corner + extent)",
        STEP,
    ),
    Fault(
        "geometry",
        "the board has a column more",
        "(cell[1] < BOARD_SIZE)",
        "(cell[1] <= BOARD_SIZE)",
        STEP,
    ),
    Fault("geometry", "one row is one cell", " & (cell[1] == other[1])", "", STEP),
    Fault("geometry", "a drawn bar is wider", "(end[1] > COLUMNS)", "(end[1] >= COLUMNS)", OBSERVE),
    Fault(
        "observation",
        "the tool hides the agent",
        "_at(state.agent), jnp.uint8(AGENT), objects)",
        "_at(state.agent) & ~tool, jnp.uint8(AGENT), objects)",
        OBSERVE,
    ),
    Fault(
        "observation",
        "food lies above the tool",
        "jnp.where(tool, jnp.uint8(TOOL), objects)",
        "jnp.where(tool & ~_at(state.food), jnp.uint8(TOOL), objects)",
        OBSERVE,
    ),
    Fault(
        "environment",
        "the limit is one step longer",
        "time >= self.max_steps",
        "time > self.max_steps",
        TIME,
    ),
    Fault(
        "environment",
        "success at the limit is a truncation",
        "(~state.terminated & (time >= self.max_steps))",
        "(time >= self.max_steps)",
        TIME,
    ),
    Fault(
        "environment",
        "a truncated state comes alive under a larger limit",
        "truncated = state.truncated | ",
        "truncated = ",
        TIME,
    ),
    Fault(
        "environment",
        "success pays again",
        "(state.terminated & ~was_done)",
        "(state.terminated)",
        TIME,
    ),
    Fault(
        "environment",
        "time runs on after the end",
        "state.time + ~was_done",
        "state.time + 1",
        TIME,
    ),
    Fault(
        "wrappers",
        "every episode draws the same task",
        "AutoResetState(inner, next_key)",
        "AutoResetState(inner, key)",
        TIME,
    ),
    Fault(
        "wrappers",
        "the last observation is lost",
        "(timestep, observation, timestep.observation)",
        "(timestep, observation, observation)",
        TIME,
    ),
    Fault(
        "transfers", "features are rounded", "jnp.floor((points", "jnp.round((points", STRUCTURAL
    ),
    Fault(
        "transfers",
        "features reach 256",
        "(points.clip(-1, 1) + 1) / 2 * 255",
        "(points.clip(-1, 1) + 1) / 2 * 256",
        STRUCTURAL,
    ),
    Fault(
        "transfers",
        "points crowd in the cube's corners",
        "jax.random.normal(loop_free(key), (5, num_features), jnp.float32)",
        "jax.random.uniform(loop_free(key), (5, num_features), minval=-1)",
        STRUCTURAL,
    ),
    Fault("transfers", "food changes its color", "(AGENT, FOOD)", "(AGENT,)", STRUCTURAL),
    Fault(
        "transfers",
        "the tool is never drawn",
        "randint(loop_free(key), (), 0, len(SYMBOLIC_OBJECTS), jnp.int32)",
        "randint(loop_free(key), (), 1, len(SYMBOLIC_OBJECTS), jnp.int32)",
        SYMBOLIC,
    ),
    Fault(
        "transfers", "colors stay at a swap", "state.palette[looks_of]", "state.palette", SYMBOLIC
    ),
    Fault(
        "transfers",
        "the new tool lies across",
        "jnp.where(horizontal, jnp.stack([1, length])",
        "jnp.where(~horizontal, jnp.stack([1, length])",
        SYMBOLIC,
    ),
    Fault(
        "transfers",
        "the swapped object stays as well",
        "jnp.where(state.board == code, jnp.uint8(GROUND), state.board)",
        "state.board",
        SYMBOLIC,
    ),
    Fault(
        "transfers",
        "every swapped tool is horizontal",
        "is_object & (cells > first)",
        "is_object & (cells >= first)",
        SYMBOLIC,
    ),
    Fault(
        "transfers", "transfers share a key", "fold_in(key, index), state)", "key, state)", COMPOSE
    ),
    Fault(
        "transfers",
        "own transfers get keys of a foreign type",
        "transfer(fold_in(key, index), state)",
        "transfer(loop_free(fold_in(key, index)), state)",
        ("tests/test_environment.py", "-k", "mix_with_own"),
    ),
    Fault(
        "transfers",
        "the last transfer comes first",
        "in enumerate(transfers):",
        "in enumerate(transfers[::-1]):",
        COMPOSE,
    ),
    Fault(
        "transfers",
        "the openings depend on the outline",
        "layout // NUM_FRAMES % NUM_ASSIGNMENTS",
        "layout % NUM_ASSIGNMENTS",
        PERCEPTUAL,
    ),
    Fault(
        "transfers",
        "some tool places are left out",
        "tool %= tables.num_tools[frame]",
        "tool %= tables.num_tools[frame] - 1",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "narrow tubes are less likely",
        "((3, 4), (3, 5), (4, 4), (4, 4))",
        "((3, 4), (4, 4), (4, 4), (4, 4))",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "the trap is always first",
        "(openings, openings[::-1])",
        "(openings, openings)",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "the agent may start on the tool",
        "~tool_corners & ~tool)",
        "~tool_corners)",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "the agent may start where the tool could",
        "~center & ~tool_corners & ~tool",
        "~center & ~tool",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "the tool may start nearer to the tube",
        "top + height - 1, left + width + 1)",
        "top + height - 1, left + width)",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "the tool may reach the last row",
        "_box(0, 0, BOARD_SIZE - 1 - height,",
        "_box(0, 0, BOARD_SIZE - height,",
        PERCEPTUAL,
    ),
    Fault(
        "layouts",
        "the central block is smaller",
        "CENTER_LAST = 4, 8",
        "CENTER_LAST = 4, 7",
        PERCEPTUAL,
    ),
    Fault(
        "graded",
        "the agent is far from the base task's at once",
        "(cells[:count].astype(np.int32), base.agent, strength)",
        "(cells[:count].astype(np.int32), base.agent, 1)",
        GRADED,
    ),
    Fault(
        "graded",
        "the direction of the tool does not count",
        "return board_cells + tool_cells[:, None]",
        "return board_cells",
        GRADED,
    ),
    Fault(
        "graded",
        "distances start at 0, not at the least",
        "nearest + strength * (farthest - nearest)",
        "np.maximum(nearest, strength * farthest)",
        GRADED,
    ),
    Fault(
        "graded",
        "points turn the whole way",
        "angle = strength * jnp.atan2",
        "angle = jnp.atan2",
        GRADED,
    ),
    Fault(
        "graded",
        "the palette loses a half at strength 0",
        "(state.palette.astype(jnp.float32) + 0.5)",
        "state.palette.astype(jnp.float32)",
        GRADED,
    ),
    Fault(
        "controls",
        "the second layout is never drawn",
        "0, len(choices), jnp.int32)",
        "0, 1, jnp.int32)",
        ("tests/test_controls.py",),
    ),
    Fault(
        "registry",
        "the set's step limit is forgotten",
        "entry.max_steps if max_steps is None",
        "MAX_STEPS if max_steps is None",
        ("tests/test_registry.py",),
    ),
)
