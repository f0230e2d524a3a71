"""Boxes about marked cells, to be searched for vehicles: few, and together small."""

import math

import numpy as np

from schemas.arrays import IntArray, Mask
from velfield.compiled import kernel


def split_into_boxes(cells: Mask, margin: float, box_cost: float) -> IntArray:
    """Disjoint boxes that cover the marked cells, cheap to search.

    Boxes are split in two, by the row or the column after which both are smallest, down to single cells; then, from
    the smallest up, a box takes the place of its parts where it costs no more. The cost of a box is its area with a
    margin on every side, plus a constant.

    Parameters
    ----------
    cells
        (rows, columns).
    margin, box_cost
        In cells, and in areas of a cell.

    Returns
    -------
    (n, 4) first row, first column, row and column after the last.
    """
    return np.asarray(_split_kernel(np.ascontiguousarray(cells), margin, box_cost))


@kernel
def _split_kernel(cells: Mask, margin: float, box_cost: float) -> IntArray:
    """Boxes (n, 4). Nodes of the tree are numbered so that parts come after the box that they are parts of."""
    height, width = cells.shape
    of_rows, of_columns = np.empty((height + 1, 2), np.int64), np.empty((width + 1, 2), np.int64)
    of_rows[height], of_columns[width] = 0, 0
    _find_extents(cells, (0, 0, height, width), of_rows, of_columns)
    nodes = [_bounds(of_rows, 0, height)]
    parts = [(0, 0)]
    done = 0
    two_cells = 2 * ((1 + 2 * margin) ** 2 + box_cost)
    while done < len(nodes):
        top, left, bottom, right = nodes[done]
        cost = (bottom - top + 2 * margin) * (right - left + 2 * margin) + box_cost
        # Parts are not made where they cannot cost less: two boxes cost no less than those of two cells, nor than
        # squares that hold as many cells as are marked.
        marked = 0.0
        if cost > two_cells:
            marked = _find_extents(cells, nodes[done], of_rows, of_columns)
        if cost <= max(two_cells, marked + 4 * margin * math.sqrt(marked) + 8 * margin * margin + 2 * box_cost):
            done += 1
            continue
        by_row, row = _best_split(of_rows, top, bottom, margin)
        by_column, column = _best_split(of_columns, left, right, margin)
        if min(by_row, by_column) < np.inf:
            if by_row <= by_column:
                nodes.append(_bounds(of_rows, top, row))
                nodes.append(_bounds(of_rows, row, bottom))
            else:
                for begin, end in ((left, column), (column, right)):
                    first_column, first_row, last_column, last_row = _bounds(of_columns, begin, end)
                    nodes.append((first_row, first_column, last_row, last_column))
            parts[done] = (len(nodes) - 2, len(nodes) - 1)
            parts.append((0, 0))
            parts.append((0, 0))
        done += 1
    costs = np.zeros(len(nodes))
    split = np.zeros(len(nodes), np.bool_)
    for k in range(len(nodes) - 1, -1, -1):
        top, left, bottom, right = nodes[k]
        costs[k] = (bottom - top + 2 * margin) * (right - left + 2 * margin) + box_cost
        one, other = parts[k]
        if one > 0 and costs[one] + costs[other] < costs[k]:
            costs[k], split[k] = costs[one] + costs[other], True
    boxes = np.empty((len(nodes), 4), np.int64)
    count = 0
    taken = np.zeros(len(nodes), np.bool_)
    taken[0] = nodes[0][2] > nodes[0][0]
    for k in range(len(nodes)):
        if taken[k] and split[k]:
            taken[parts[k][0]] = taken[parts[k][1]] = True
        elif taken[k]:
            for side in range(4):
                boxes[count, side] = nodes[k][side]
            count += 1
    return boxes[:count]


@kernel
def _find_extents(
    cells: Mask, box: tuple[int, int, int, int] | tuple[int, ...], of_rows: IntArray, of_columns: IntArray
) -> int:
    """First marked cell of each row and column of a box, and that after the last; the last is 0 where none is.

    Returns their number.
    """
    top, left, bottom, right = box
    width, count = np.uint64(right - left), 0
    # Of the columns, counted from ``left``: without a branch on each cell, so that the loop is vectorised.
    first, last = np.full(right - left, bottom, np.int32), np.zeros(right - left, np.int32)
    for row in range(top, bottom):
        line, marked, below, after = cells[row, left:right], np.int32(0), np.int32(row), np.int32(row + 1)
        for column in range(width):
            marked += np.int32(line[column])
        of_rows[row, 0], of_rows[row, 1] = right, 0
        if marked == 0:
            continue
        count += int(marked)
        for column in range(width):
            first[column] = min(first[column], below) if line[column] else first[column]
            last[column] = after if line[column] else last[column]
        begin, end = left, right
        while not cells[row, begin]:
            begin += 1
        while not cells[row, end - 1]:
            end -= 1
        of_rows[row, 0], of_rows[row, 1] = begin, end
    for column in range(width):
        of_columns[left + column, 0], of_columns[left + column, 1] = first[column], last[column]
    return count


@kernel
def _bounds(extents: IntArray, begin: int, end: int) -> tuple[int, ...]:
    """Bounding box of the marked cells in a range of rows (or columns): first row and column, and one past the last."""
    while begin < end and extents[begin, 1] == 0:
        begin += 1
    while end > begin and extents[end - 1, 1] == 0:
        end -= 1
    first, last = extents[begin, 0], extents[begin, 1]
    for line in range(begin + 1, end):
        if extents[line, 1] > 0:
            first, last = min(first, extents[line, 0]), max(last, extents[line, 1])
    return begin, first, end, last


@kernel
def _best_split(extents: IntArray, begin: int, end: int, margin: float) -> tuple[float, int]:
    """The least area of two boxes with margins, of the rows (or columns) of a box before and after one, and that row;
    inf for one row. The first and the last have a mark."""
    count = end - begin
    if count < 2:
        return np.inf, begin
    area = np.zeros(count)
    for way in range(2):
        edge = 0 if way == 0 else count - 1
        first, last, nearest = extents[begin + edge, 0], extents[begin + edge, 1], edge
        for step in range(count - 1):
            line = step if way == 0 else count - 1 - step
            if extents[begin + line, 1] > 0:
                first, last = min(first, extents[begin + line, 0]), max(last, extents[begin + line, 1])
                nearest = line
            size = abs(nearest - edge) + 1
            area[line + 1 if way == 0 else line] += (size + 2 * margin) * (last - first + 2 * margin)
    best = 1
    for line in range(2, count):
        if area[line] < area[best]:
            best = line
    return area[best], begin + best
