"""One switch for each remedy that is in code, so that a test can take it away.

The comment after a switch names the hole of the paper's protocol that it closes, as counted in
docs/ownership.md. All are on; only tests switch one off, and each of them makes a test fail.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Safeguards:
    """Remedies of the protocol; `Safeguards(ack_freshness=False)` takes one away."""

    # The lease and the switch
    one_step_lease: bool = True  # H1: OUT ends the authority of the source before IN begins another
    copy_until_commit: bool = True  # H2: the source keeps its frozen row until the switch commits
    exact_promotion: bool = True  # H3: a host promotes the exact replica, or asks for the state
    reattach: bool = True  # H9: a target without its replica is sent the state again
    deadline: bool = True  # H14: after D ticks the hand-off is forced
    target_by_position: bool = True  # H17, H18: the target is where the vehicle is, not was

    # Acknowledgements
    ack_freshness: bool = True  # H3, H4: an ACK counts for its own tick and epoch only
    ack_incarnation: bool = True  # H8, H26: an ACK of a dead process counts for nothing
    ack_digest: bool = True  # H25: an ACK names the digest of the state that it holds
    state_digest: bool = True  # H25: a state that does not match its digest is refused
    state_schema: bool = True  # H25: a state of another schema is refused

    # Replicas
    abort_fence: bool = True  # H5: an older ABORT does not drop a newer replica
    fence_stays: bool = True  # H6: the fence stays when the replica goes
    replica_slot: bool = True  # H7: a PREPARE never touches the row that is owned
    replica_lifetime: bool = True  # I8: a replica that is not refreshed expires

    # Ticks, runs, episodes, processes
    log_before_send: bool = True  # H11, H23: a decision is logged before anyone hears of it
    done_incarnation: bool = True  # H12: a DONE of a fenced process counts for nothing
    step_tick: bool = True  # H13: a STEP is executed once
    done_tick: bool = True  # H13: a DONE counts for its own tick only
    answer_again: bool = True  # H13: a repeated STEP is answered, from memory
    tick_never_resets: bool = True  # H15: a reset begins an episode, and the ticks go on
    run_fence: bool = True  # H15: messages of another run are dropped
    repeat_limit: bool = True  # H22: a tick that kills every host ends in an error

    # The ledger and the committed store
    removed_is_final: bool = True  # H19: an id that has been in the episode never returns
    ledger: bool = True  # I6: nothing is lost or doubled, or the tick is not committed
    double_buffer: bool = True  # H10: tick t stays whole until t+1 is committed
    segment_per_incarnation: bool = True  # H28: a process writes to a segment of its own
    digest_before_commit: bool = True  # H28: what is stored is what DONE told of

    # Distances
    hysteresis: bool = True  # H16: a vehicle that weaves on a border does not change owner
    early_offer: bool = True  # H20: a vehicle is offered before it crosses


ALL_ON = Safeguards()
