"""What processes tell each other about agents: rows of tables, actions, and results, as bytes.

Rows of tables are how many agents there are, in 8 bytes; their numbers, in 8 bytes each; and then,
agent by agent, the row of each table.

Actions are words of 8 bytes: how many agents the process owns that they go to, and how many have no
vehicle; and then of each its number, two controls and a meta-action.

Results are what all processes know alike, where it is told; rows of what agents sense; and rows of
what agents sensed before something ended. Each part begins at a whole word.
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
"""(A, b) b bytes of each agent."""

UNOWNED = -1  # owns an agent that has no vehicle


@inlined_kernel
def _put(part: Bytes, data: Bytes, at: int) -> int:
    """Write some bytes; where they end."""
    for c in range(part.size):
        data[at + c] = part[c]
    return int(at + part.size)


@inlined_kernel
def _take(part: Bytes, data: Bytes, at: int) -> int:
    """Read them."""
    for c in range(part.size):
        part[c] = data[at + c]
    return int(at + part.size)


@inlined_kernel
def _aligned(at: int) -> int:
    """The next whole word."""
    return (at + 7) // 8 * 8


# Rows of tables


@kernel
def pack_agents(
    mine: Flags,  # (A,) agents that are told of
    tables: tuple[Table, ...],
    words: Words,  # written: the frame, with room for all agents
    data: Bytes,  # the same memory
) -> int:
    """Write a frame; how many bytes it has."""
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
    tables: tuple[Table, ...],  # written
    words: Words,  # the first whole words of the frame
    data: Bytes,  # the frame, and what follows
    number: int,  # of the process that it comes from
    owner: Owners,  # (A,) written: that number
) -> int:
    """Take a frame.

    Returns:
        how many bytes it has; -1: it is none that `pack_agents` makes, and nothing is written.
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
    chosen: Flags,  # (W,) in these worlds
    number: int,  # of the process
    own: Flags,  # (W, A) written: those that have sensed here last
    mine: Flags,  # (W · A,) written: those of them that are in the chosen worlds
    owner: Owners,  # (W · A,) written: the number, or `UNOWNED`
) -> None:
    """Note which agents belong to this process, as far as it knows."""
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
    owner: Owners,  # (A,) the process of each, as far as is known
    number: int,  # of the one that is told
    words: Words,  # (2 + 4 · A,) written
    numbers: NDArray[np.float64],  # the same memory
) -> int:
    """Write what agents of a process do, and those of none; how many words that has."""
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
    words: Words,  # they begin with them
    numbers: NDArray[np.float64],  # the same memory
    controls: NDArray[np.float64],  # (A, 2) written
    meta_actions: NDArray[np.int64],  # (A,) written
    missing: Flags,  # (A,) agents whose actions are awaited; those that come are so no longer
    owner: Owners,  # (A,) the process of each
    number: int,  # of this one
    wrong: Words,  # (A,) written, first of all: agents of another one
) -> tuple[int, int, int]:
    """Take actions.

    Returns:
        how many words they have, -1: they are none that `pack_actions` makes, and nothing is
        written; how many agents are wrong; how many are still missing.
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
    """What results are of, and go to."""

    common: tuple[Bytes, ...]  # what all processes know alike
    sensed: tuple[Table, ...]
    final: tuple[Table, ...]  # the same where something ended, before that
    episode_over: Flags  # (W,) one of the common ones
    terminations: Flags  # (W, A) likewise


@inlined_kernel
def _has_ended(told: Outcome, w: int) -> bool:
    ended = told.episode_over[w]
    for agent in range(told.terminations.shape[1]):
        ended |= told.terminations[w, agent]
    return bool(ended)


@kernel
def pack_results(
    told: Outcome,
    own: Flags,  # (W, A) agents that have sensed in this process
    chosen: Flags,  # (W,) the worlds that have been reset, or stepped
    before: Flags,  # (W, A) agents that had sensed here before worlds began anew
    of_step: bool,
    with_common: bool,
    mine: Flags,  # (W · A,) scratch
    words: Words,  # written
    data: Bytes,  # the same memory
) -> int:
    """Write results; how many bytes they have."""
    end = 0
    if with_common:
        for part in told.common:
            end = _put(part, data, end)
    num_agents = own.shape[1]
    at = _aligned(end)
    for w in range(chosen.size):
        for agent in range(num_agents):
            mine[w * num_agents + agent] = chosen[w] and own[w, agent]
    end = at + pack_agents(mine, told.sensed, words[at // 8 :], data[at:])
    if of_step:
        at = _aligned(end)
        for w in range(chosen.size):
            ended = _has_ended(told, w)
            for agent in range(num_agents):
                mine[w * num_agents + agent] = ended and before[w, agent]
        end = at + pack_agents(mine, told.final, words[at // 8 :], data[at:])
    return end


@kernel
def take_results(
    told: Outcome,  # written
    chosen: Flags,  # (W,) the worlds that have been reset, or stepped
    of_step: bool,
    with_common: bool,  # of the process whose results are taken first
    number: int,  # of that process
    owner: Owners,  # (W · A,) written: the process of each agent
    unread: Owners,  # (W · A,) scratch
    words: Words,  # the first whole words of them
    data: Bytes,
) -> bool:
    """Take results; whether they are what `pack_results` makes."""
    end = 0
    if with_common:
        for part in told.common:
            end += part.size
        if end > data.size:
            return False
        end = 0
        for part in told.common:
            end = _take(part, data, end)
        _begin(told, chosen, of_step, owner)
    at = _aligned(end)
    if at > data.size:
        return False
    size = take_agents(told.sensed, words[at // 8 :], data[at:], number, owner)
    end = at + size
    if size >= 0 and of_step:
        at = _aligned(end)
        if at > data.size:
            return False
        size = take_agents(told.final, words[at // 8 :], data[at:], number, unread)
        end = at + size
    return bool(size >= 0 and end == data.size)


@inlined_kernel
def _begin(told: Outcome, chosen: Flags, of_step: bool, owner: Owners) -> None:
    """Agents without a vehicle have zeros, in the chosen worlds, and no process."""
    num_agents = told.terminations.shape[1]
    for w in range(chosen.size):
        ended = of_step and _has_ended(told, w)
        for agent in range(w * num_agents, (w + 1) * num_agents):
            if chosen[w]:
                owner[agent] = UNOWNED
                for table in told.sensed:
                    table[agent, :] = 0
            if ended:
                for table in told.final:
                    table[agent, :] = 0
