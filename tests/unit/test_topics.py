"""The table of topics, walked."""

from __future__ import annotations

import numpy as np
import pytest
import zenoh

from protocol import messages, topics
from protocol.topics import TOPICS, Topic, alive_key
from protocol.wire import MAX_MESSAGE_BYTES, Message

each_topic = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)


def test_every_topic_is_in_the_table() -> None:
    defined = [value for value in vars(topics).values() if isinstance(value, Topic)]

    assert sorted(topic.key for topic in TOPICS) == sorted(topic.key for topic in defined)


def test_keys_are_unique() -> None:
    assert len({topic.key for topic in TOPICS}) == len(TOPICS)


def test_names_on_the_wire_are_unique() -> None:
    kinds = [kind for kind in vars(messages).values() if isinstance(kind, type) and issubclass(kind, Message)]
    names = [kind.name for kind in kinds if kind is not Message]

    assert len(set(names)) == len(names)


def test_the_keys_of_the_design_are_there() -> None:
    assert {
        "drone/{drone}/state",
        "drone/{drone}/keyframe",
        "phi/jump",
        "phi/head",
        "phi/journal",
        "command/all",
        "clock/tick",
    } <= {topic.key for topic in TOPICS}
    assert alive_key("drone/3") == "alive/drone/3"


@each_topic
def test_a_topic_carries_a_message_with_a_wire_name(topic: Topic[Message]) -> None:
    assert issubclass(topic.message, Message)
    assert topic.message.name


@each_topic
def test_a_topic_keeps_at_least_one_message_and_its_age_is_bounded_from_below(topic: Topic[Message]) -> None:
    assert topic.queue >= 1
    assert topic.max_age_s > 0


@each_topic
def test_a_topics_priority_is_one_that_the_transport_has(topic: Topic[Message]) -> None:
    assert isinstance(getattr(zenoh.Priority, topic.priority), zenoh.Priority)


@each_topic
def test_a_key_is_that_of_one_drone_or_of_all(topic: Topic[Message]) -> None:
    assert topic.of(3) == topic.key.replace("{drone}", "3")
    assert topic.of("*") == topic.key.replace("{drone}", "*")
    for key in (topic.of(3), topic.of("*")):
        zenoh.KeyExpr(key)  # refuses what is not canonical


@each_topic
def test_a_topic_has_somebody_who_writes_and_somebody_who_reads_it(topic: Topic[Message]) -> None:
    assert topic.writers
    assert topic.readers


@each_topic
def test_a_topics_messages_are_bounded_and_no_longer_than_any_message_may_be(topic: Topic[Message]) -> None:
    assert 0 < topic.max_bytes <= MAX_MESSAGE_BYTES


def test_who_speaks_for_another_drone_than_its_keys_is_found() -> None:
    event = messages.Event(source="drone/3", tick=1, level="info", kind="mode", text="x")
    setpoint = messages.Setpoint(drone=3, tick=1, velocity=(0.0, 0.0, 0.0, 0.0, 0.0))
    page = messages.PhiPage(
        epoch=1, tick=1, next_sequence=0, blocks=np.zeros(0, np.int32), phi=np.zeros((0, 1), np.float32)
    )
    assert topics.EVENT.contradiction("drone/3/event", event) == ""
    assert topics.EVENT.contradiction("drone/2/event", event) == "speaks for drone/3"
    assert topics.SETPOINT.contradiction("drone/3/setpoint", setpoint) == ""
    assert topics.SETPOINT.contradiction("drone/33/setpoint", setpoint) == "speaks for drone/3"
    assert topics.DRONE_BLOCKS.contradiction("drone/2/phi", page) == "", "it speaks for nobody"
    assert topics.GROUND_EVENT.contradiction("ground/event", event) == "", "not a drone's key"
