"""Frames about agents that processes exchange: rows of tables, actions, and results, as bytes.

An agent has sensed in the process that has computed its newest observation.

A frame of rows has the number of agents in 8 bytes, the index of each agent in 8 bytes, and then,
agent by agent, the row of each table.

A frame of actions has words of 8 bytes: the number of agents of the receiving process, the number
of agents without a vehicle, and then for each agent its index, two controls and a meta-action.

A frame of results has the data that all processes share, if included; rows of observations; and
rows of observations before an agent or an episode ended. Each part begins at a whole word.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel

Bytes = NDArray[np.uint8]
Words = NDArray[np.int64]
Flags = NDArray[np.bool_]
Owners = NDArray[np.int32]

Table = NDArray[np.uint8]
"""(A, b): b bytes for each agent."""

UNOWNED = -1  # the owner of an agent without a vehicle


@inlined_kernel
def _put(part: Bytes, data: Bytes, at: int) -> int:
    """Write bytes to a frame. Return where they end."""
    for c in range(part.size):
        data[at + c] = part[c]
    return int(at + part.size)


@inlined_kernel
def _take(part: Bytes, data: Bytes, at: int) -> int:
    """Read bytes from a frame. Return where they end."""
    for c in range(part.size):
        part[c] = data[at + c]
    return int(at + part.size)


@inlined_kernel
def _aligned(at: int) -> int:
    """Return the start of the next whole word."""
    return (at + 7) // 8 * 8


# Rows of tables


@kernel
def pack_agents(
    mine: Flags,  # (A,) agents in the frame
    tables: tuple[Table, ...],
    words: Words,  # output: the frame, with room for all agents
    data: Bytes,  # the same memory
) -> int:  # number of bytes
    """Write a frame of rows."""
    num = 0
    for agent in range(mine.size):
        if mine[agent]:
            num += 1
            words[num] = agent
    words[0] = num
    at = 8 * (1 + num)
    for n in range(num):
        for table in tables:
            at = _put(table[words[1 + n]], data, at)
    return at


@kernel
def take_agents(
    tables: tuple[Table, ...],  # output
    words: Words,  # the first whole words of the frame
    data: Bytes,  # the frame and the following bytes
    number: int,  # number of the sending process
    owner: Owners,  # (A,) output: `number` for each agent in the frame
) -> int:
    """Read a frame of rows.

    Returns:
        The number of bytes; -1 if `pack_agents` has not made the frame; then nothing is written.
    """
    size = 8
    for table in tables:
        size += table.shape[1]
    if words.size == 0 or words[0] < 0 or words[0] > owner.size:
        return -1
    num = words[0]
    if data.size < 8 + num * size:
        return -1
    for n in range(num):
        if words[1 + n] < 0 or words[1 + n] >= owner.size:
            return -1
    at = 8 * (1 + num)
    for n in range(num):
        owner[words[1 + n]] = number
        for table in tables:
            at = _take(table[words[1 + n]], data, at)
    return int(at)


@kernel
def note_own(
    present: Flags,  # (W, A) agents that have sensed in this process
    chosen: Flags,  # (W,) worlds to update
    number: int,  # number of this process
    own: Flags,  # (W, A) output: `present`, in the worlds to update
    mine: Flags,  # (W · A,) output: agents of `own` in the chosen worlds
    owner: Owners,  # (W · A,) output: `number`, or `UNOWNED`
) -> None:
    """Record which agents this process owns, according to its own knowledge."""
    at = 0
    for w in range(own.shape[0]):
        for agent in range(own.shape[1]):
            if chosen[w]:
                own[w, agent] = present[w, agent]
                owner[at] = number if own[w, agent] else UNOWNED
            mine[at] = chosen[w] and own[w, agent]
            at += 1


@kernel
def pack_actions(
    controls: NDArray[np.float64],  # (A, 2)
    meta_actions: NDArray[np.int64],  # (A,)
    mask: Flags,  # (A,) agents that act
    owner: Owners,  # (A,) the process of each agent, as far as known
    number: int,  # number of the receiving process
    words: Words,  # (2 + 4 · A,) output
    numbers: NDArray[np.float64],  # the same memory
) -> int:  # number of words
    """Write a frame of the actions of a process's agents and of agents without a vehicle."""
    at = 2
    for part in range(2):
        words[part] = 0
        wanted = number if part == 0 else UNOWNED
        for agent in range(mask.size):
            known = owner[agent] if mask[agent] else UNOWNED
            if known == wanted:
                words[part] += 1
                words[at] = agent
                numbers[at + 1] = controls[agent, 0]
                numbers[at + 2] = controls[agent, 1]
                words[at + 3] = meta_actions[agent]
                at += 4
    return at


@kernel
def take_actions(
    words: Words,  # the frame and following bytes
    numbers: NDArray[np.float64],  # the same memory
    controls: NDArray[np.float64],  # (A, 2) output
    meta_actions: NDArray[np.int64],  # (A,) output
    missing: Flags,  # (A,) output: agents whose actions have not arrived
    owner: Owners,  # (A,) the process of each agent
    number: int,  # number of this process
    wrong: Words,  # (A,) output in the first entries: agents of another process
) -> tuple[int, int, int]:
    """Read a frame of actions.

    Returns:
        The number of words, or -1 if `pack_actions` has not made the frame (then nothing is
        written); the number of agents in `wrong`; the number of agents in `missing`.
    """
    num_agents = missing.size
    if words.size < 2 or min(words[0], words[1]) < 0 or max(words[0], words[1]) > num_agents:
        return -1, 0, 0
    num = words[0] + words[1]
    if words.size < 2 + 4 * num:
        return -1, 0, 0
    for n in range(num):
        if words[2 + 4 * n] < 0 or words[2 + 4 * n] >= num_agents:
            return -1, 0, 0
    num_wrong = 0
    for n in range(num):
        at = 2 + 4 * n
        agent = words[at]
        controls[agent, 0] = numbers[at + 1]
        controls[agent, 1] = numbers[at + 2]
        meta_actions[agent] = words[at + 3]
        missing[agent] = False
        if n < words[0] and owner[agent] != number:
            wrong[num_wrong] = agent
            num_wrong += 1
    num_missing = 0
    for agent in range(num_agents):
        num_missing += missing[agent]
    return int(2 + 4 * num), num_wrong, num_missing


# Results


class Outcome(NamedTuple):
    """The arrays with the results of agents."""

    common: tuple[Bytes, ...]  # data that all processes share
    sensed: tuple[Table, ...]  # observations
    final: tuple[Table, ...]  # observations before an agent or an episode ended
    episode_over: Flags  # (W,) part of `common`
    terminations: Flags  # (W, A) part of `common`


@inlined_kernel
def _has_ended(outcome: Outcome, w: int) -> bool:
    ended = outcome.episode_over[w]
    for agent in range(outcome.terminations.shape[1]):
        ended |= outcome.terminations[w, agent]
    return bool(ended)


@kernel
def pack_results(
    outcome: Outcome,
    own: Flags,  # (W, A) agents that have sensed in this process
    chosen: Flags,  # (W,) the worlds that have been reset, or stepped
    before: Flags,  # (W, A) agents that had sensed here before worlds were reset
    of_step: bool,  # whether results are of a step; if not, of a reset
    with_common: bool,  # whether to include `outcome.common`
    mine: Flags,  # (W · A,) scratch
    words: Words,  # output
    data: Bytes,  # the same memory
) -> int:  # number of bytes
    """Write a frame of results."""
    end = 0
    if with_common:
        for part in outcome.common:
            end = _put(part, data, end)
    num_agents = own.shape[1]
    at = _aligned(end)
    for w in range(chosen.size):
        for agent in range(num_agents):
            mine[w * num_agents + agent] = chosen[w] and own[w, agent]
    end = at + pack_agents(mine, outcome.sensed, words[at // 8 :], data[at:])
    if of_step:
        at = _aligned(end)
        for w in range(chosen.size):
            ended = _has_ended(outcome, w)
            for agent in range(num_agents):
                mine[w * num_agents + agent] = ended and before[w, agent]
        end = at + pack_agents(mine, outcome.final, words[at // 8 :], data[at:])
    return end


@kernel
def take_results(
    outcome: Outcome,  # output
    chosen: Flags,  # (W,) the worlds that have been reset, or stepped
    of_step: bool,  # whether results are of a step; if not, of a reset
    with_common: bool,  # true for the process whose results are read first
    number: int,  # number of the sending process
    owner: Owners,  # (W · A,) output: the process of each agent
    unread: Owners,  # (W · A,) scratch
    words: Words,  # the first whole words of the frame
    data: Bytes,
) -> bool:  # whether `pack_results` has made the frame
    """Read a frame of results."""
    end = 0
    if with_common:
        for part in outcome.common:
            end += part.size
        if end > data.size:
            return False
        end = 0
        for part in outcome.common:
            end = _take(part, data, end)
        _begin(outcome, chosen, of_step, owner)
    at = _aligned(end)
    if at > data.size:
        return False
    size = take_agents(outcome.sensed, words[at // 8 :], data[at:], number, owner)
    end = at + size
    if size >= 0 and of_step:
        at = _aligned(end)
        if at > data.size:
            return False
        size = take_agents(outcome.final, words[at // 8 :], data[at:], number, unread)
        end = at + size
    return bool(size >= 0 and end == data.size)


@inlined_kernel
def _begin(outcome: Outcome, chosen: Flags, of_step: bool, owner: Owners) -> None:
    """Clear the observations and the owners of all agents in the chosen worlds."""
    num_agents = outcome.terminations.shape[1]
    for w in range(chosen.size):
        ended = of_step and _has_ended(outcome, w)
        for agent in range(w * num_agents, (w + 1) * num_agents):
            if chosen[w]:
                owner[agent] = UNOWNED
                for table in outcome.sensed:
                    table[agent, :] = 0
            if ended:
                for table in outcome.final:
                    table[agent, :] = 0
