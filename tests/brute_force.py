"""The rules of environment.md, "One step", in plain Python, and an exhaustive search over them.

Shares no code with the package, on purpose.
"""

from collections import deque
from typing import NamedTuple

Cell = tuple[int, int]
Place = tuple[Cell, Cell, Cell]  # agent, the tool's top-left cell, food
GROUND, EXIT = 0, 2
VECTORS = ((-1, 0), (1, 0), (0, -1), (0, 1))
ACTIONS = [(grasp, move) for grasp in range(4) for move in range(4)]


class Task(NamedTuple):
    """What stays: the static objects' codes, row by row, and the tool's (rows, columns)."""

    board: list[list[int]]
    extent: Cell


def read(state) -> tuple[Task, Place]:
    """A state's task and place, as Python numbers."""
    agent, tool, food, extent = (
        (int(cell[0]), int(cell[1]))
        for cell in (state.agent, state.tool, state.food, state.tool_extent)
    )
    return Task(state.board.tolist(), extent), (agent, tool, food)


def move(task: Task, place: Place, action: Cell) -> Place:
    """One step of an unfinished episode."""
    agent, tool, food = place
    grasp, push = VECTORS[action[0]], VECTORS[action[1]]
    before = _cells(task, tool)
    held = _plus(agent, grasp) in before and agent not in before
    ahead = _plus(agent, push)
    way_is_free = _object(task, ahead) == GROUND
    runs_into_food = food not in before and (food[0] - push[0], food[1] - push[1]) in before
    beyond = _plus(food, push)
    food_yields = _object(task, beyond) in (GROUND, EXIT) and beyond not in before

    new_food = food
    if held and way_is_free and runs_into_food and food_yields:
        new_food = beyond
    new_tool = tool
    if held:
        shifted = _plus(tool, push)
        fits = all(_object(task, cell) is not None for cell in _cells(task, shifted))
        if way_is_free and (not runs_into_food or new_food != food) and fits:
            new_tool = shifted
        else:
            return agent, tool, new_food
    enters = way_is_free or ahead == new_food
    if _object(task, ahead) is not None and ahead not in _cells(task, new_tool) and enters:
        return ahead, new_tool, new_food
    return agent, new_tool, new_food


def graph(task: Task, start: Place) -> dict[Place, list[Place]]:
    """The successors of every place that can be reached, by action; none of a solved one."""
    found: dict[Place, list[Place]] = {start: []}
    waiting = deque([start])
    while waiting:
        place = waiting.popleft()
        if _is_solved(place):
            continue
        found[place] = [move(task, place, action) for action in ACTIONS]
        for following in found[place]:
            if following not in found:
                found[following] = []
                waiting.append(following)
    return found


def distances_from(start: Place, edges: dict[Place, list[Place]]) -> dict[Place, int]:
    """Fewest steps from the start to every place that can be reached."""
    steps = {start: 0}
    waiting = deque(steps)
    while waiting:
        place = waiting.popleft()
        for following in edges[place]:
            if following not in steps:
                steps[following] = steps[place] + 1
                waiting.append(following)
    return steps


def distances_to_goal(edges: dict[Place, list[Place]]) -> dict[Place, int]:
    """Fewest steps to a solved place, of those that have a way to one."""
    leads_here: dict[Place, list[Place]] = {place: [] for place in edges}
    for place, successors in edges.items():
        for following in successors:
            leads_here[following].append(place)
    steps = {place: 0 for place in edges if _is_solved(place)}
    waiting = deque(steps)
    while waiting:
        place = waiting.popleft()
        for earlier in leads_here[place]:
            if earlier not in steps:
                steps[earlier] = steps[place] + 1
                waiting.append(earlier)
    return steps


def first_plan(task: Task, start: Place) -> list[Cell] | None:
    """The shortest plan whose actions come first in the order of `ACTIONS`, or None."""
    edges = graph(task, start)
    steps = distances_to_goal(edges)
    if start not in steps:
        return None
    place, plan = start, []
    while steps[place]:
        action = next(
            index
            for index, following in enumerate(edges[place])
            if steps.get(following) == steps[place] - 1
        )
        plan.append(ACTIONS[action])
        place = edges[place][action]
    return plan


def is_solved_within(task: Task, start: Place, steps: int) -> bool:
    """Whether any sequence of at most `steps` actions solves the task."""
    known, newest = {start}, {start}
    for _ in range(steps):
        following = {move(task, place, action) for place in newest for action in ACTIONS}
        if any(map(_is_solved, following)):
            return True
        newest = following - known
        known |= newest
    return False


def _is_solved(place: Place) -> bool:
    return place[0] == place[2]


def _plus(cell: Cell, vector: Cell) -> Cell:
    return cell[0] + vector[0], cell[1] + vector[1]


def _cells(task: Task, corner: Cell) -> set[Cell]:
    rows, columns = task.extent
    return {
        (corner[0] + row, corner[1] + column) for row in range(rows) for column in range(columns)
    }


def _object(task: Task, cell: Cell) -> int | None:
    on_board = 0 <= cell[0] < 12 and 0 <= cell[1] < 12
    return task.board[cell[0]][cell[1]] if on_board else None
