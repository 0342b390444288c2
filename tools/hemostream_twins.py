"""Checks that every message and its JSON twin say the same."""

from __future__ import annotations

from collections import Counter, OrderedDict

from hemostream_wire import Header, Message, differences

MAX_WAITING = 256
"""Messages per key that wait for their twin."""


class TwinCheck:
    """Pairs messages with their twins by sequence number and event time, and compares them."""

    def __init__(self) -> None:
        self._waiting: dict[tuple[str, str], OrderedDict[tuple[int, int], tuple[bool, Message]]] = {}
        self.compared: Counter[str] = Counter()
        """Pairs compared, per key."""
        self.unpaired: Counter[str] = Counter()
        """Messages whose twin did not come, per key; losses under congestion end here."""
        self.mismatches = 0

    def add(self, bed: str, topic: str, is_json: bool, header: Header, message: Message) -> list[str]:
        """Takes one of the two; what differs once both are there, in words."""
        waiting = self._waiting.setdefault((bed, topic), OrderedDict())
        identity = (header.sequence, header.time_ns)
        other = waiting.get(identity)
        if other is None or other[0] == is_json:
            waiting[identity] = (is_json, message)
            if len(waiting) > MAX_WAITING:
                waiting.popitem(last=False)
                self.unpaired[topic] += 1
            return []
        del waiting[identity]
        self.compared[topic] += 1
        found = differences(other[1], message) if is_json else differences(message, other[1])
        self.mismatches += bool(found)
        return found

    def finish(self) -> None:
        """Counts what still waits, except the newest of each key: its twin may be on its way."""
        for (_, topic), waiting in self._waiting.items():
            self.unpaired[topic] += max(len(waiting) - 1, 0)
        self._waiting.clear()

    def never_compared(self) -> list[str]:
        """Keys of which messages came, but no pair."""
        return sorted(topic for topic, count in self.unpaired.items() if count and not self.compared[topic])
