"""Who gets a message now: shares of keys, slow receivers, rests."""

from collections import Counter

import pytest

from service.receivers import LONGEST_REST_S, MAX_PER_KEY, MAX_SLOW, MAX_SLOW_PER_KEY, SENDERS, SLOW_S, Due, Receivers

REST_S = 5.0


def line(number: int, *, payers: int = 1, prefix: str = "r") -> list[Due]:
    """So many deliveries, each to a receiver of its own; payers take turns."""
    return [Due(f"{prefix}-d{k}", f"{prefix}{k}", f"p{k % payers}") for k in range(number)]


def begin(receivers: Receivers, chosen: list[Due], now_s: float = 0.0) -> None:
    for due in chosen:
        receivers.begin(due.receiver, due.payer, now_s)


def end(receivers: Receivers, chosen: list[Due], duration_s: float, now_s: float, *, was_reached: bool = True) -> None:
    for due in chosen:
        receivers.end(due.receiver, duration_s, was_reached=was_reached, now_s=now_s)


def test_a_receiver_gets_one_message_at_a_time() -> None:
    receivers = Receivers(REST_S)
    same = [Due("first", "r", "p"), Due("second", "r", "p"), Due("third", "other", "p")]
    chosen = receivers.chosen(same, 0.0)
    assert [due.delivery_id for due in chosen] == ["first", "third"]
    begin(receivers, chosen)
    assert receivers.avoided(0.0).receivers == {"r", "other"}
    assert receivers.chosen(same, 0.0) == []
    end(receivers, chosen, 0.01, 0.01)
    assert (receivers.under_way, receivers.avoided(0.02).receivers) == (0, frozenset())


def test_a_key_holds_at_most_its_share_of_the_senders() -> None:
    receivers = Receivers(REST_S)
    chosen = receivers.chosen(line(3 * SENDERS), 0.0)
    assert len(chosen) == MAX_PER_KEY
    begin(receivers, chosen)
    assert receivers.avoided(0.0).payers == {"p0"}
    others = [Due("x", "other", "other key")]
    assert receivers.chosen([*line(3 * SENDERS, prefix="more"), *others], 0.0) == others


def test_all_keys_together_hold_all_senders_and_not_more() -> None:
    receivers = Receivers(REST_S)
    chosen = receivers.chosen(line(3 * SENDERS, payers=4), 0.0)
    assert len(chosen) == SENDERS
    begin(receivers, chosen)
    assert receivers.under_way == SENDERS
    assert receivers.chosen(line(9, payers=9, prefix="late"), 0.0) == []


def test_slow_receivers_leave_senders_to_quick_ones() -> None:
    receivers = Receivers(REST_S)
    slow, quick = line(400, payers=4, prefix="slow"), line(40, payers=4, prefix="quick")
    # that they are slow is known after their first messages
    for portion in (slow[:SENDERS], slow[SENDERS : 2 * SENDERS]):
        begin(receivers, portion)
        end(receivers, portion, SLOW_S + 1.0, 10.0)
    known = slow[: 2 * SENDERS]
    chosen = receivers.chosen([*known, *quick], 20.0)
    assert Counter(due.receiver.startswith("quick") for due in chosen) == {False: MAX_SLOW, True: len(quick)}
    begin(receivers, chosen[:MAX_SLOW], 20.0)
    # none of the known ones is even looked at
    assert {due.receiver for due in known} <= receivers.avoided(20.0).receivers
    assert receivers.chosen([*known, *quick], 20.0) == quick


def test_the_slow_receivers_of_one_key_leave_room_to_those_of_others() -> None:
    receivers = Receivers(REST_S)
    mine, yours = line(60, prefix="mine"), [Due("y", "yours", "other key")]
    begin(receivers, [*mine, *yours])
    end(receivers, [*mine, *yours], SLOW_S + 1.0, 5.0)
    chosen = receivers.chosen([*mine, *yours], 6.0)
    assert Counter(due.payer for due in chosen) == {"p0": MAX_SLOW_PER_KEY, "other key": 1}


def test_a_receiver_that_does_not_answer_for_a_while_counts_as_slow_meanwhile() -> None:
    receivers = Receivers(REST_S)
    hanging = line(MAX_SLOW_PER_KEY, prefix="hangs")
    begin(receivers, hanging)
    slow = [Due("s", "slow", "p0")]
    begin(receivers, slow)
    end(receivers, slow, SLOW_S + 1.0, 2.0)
    assert receivers.chosen(slow, SLOW_S / 2.0) == slow
    assert receivers.chosen(slow, 3.0) == []


def test_a_receiver_that_was_quick_again_is_forgotten() -> None:
    receivers = Receivers(REST_S)
    one = line(1)
    for duration_s in (SLOW_S + 1.0, 0.1):
        begin(receivers, one)
        end(receivers, one, duration_s, 5.0)
    assert receivers._known == {}


@pytest.mark.parametrize(("failures", "rest_s"), [(1, REST_S), (2, 3 * REST_S), (3, 9 * REST_S), (40, LONGEST_REST_S)])
def test_a_receiver_that_cannot_be_reached_rests_as_a_whole(failures: int, rest_s: float) -> None:
    receivers = Receivers(REST_S)
    one = line(1)
    for _ in range(failures):
        begin(receivers, one)
        end(receivers, one, 0.1, 100.0, was_reached=False)
    assert receivers.chosen(one, 100.0 + 0.9 * rest_s) == []
    assert receivers.avoided(100.0 + 0.9 * rest_s).receivers == {"r0"}
    assert receivers.chosen(one, 100.0 + 1.1 * rest_s) == one
    # an answer, whichever, ends it
    begin(receivers, one)
    end(receivers, one, 0.1, 500.0)
    assert receivers.chosen(one, 500.0) == one


def test_what_is_remembered_is_bounded() -> None:
    receivers = Receivers(REST_S)
    many = line(5000, prefix="gone")
    begin(receivers, [Due("x", "busy", "p")])
    for due in many:
        begin(receivers, [due])
        end(receivers, [due], 0.1, 1.0, was_reached=False)
    assert len(receivers._known) <= 2001
    assert receivers.under_way == 1
