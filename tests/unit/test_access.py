"""The access rules, walked through the table of topics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import zenoh

from protocol.access import access_control
from protocol.topics import TOPICS, Topic, alive_key
from protocol.wire import Message

NAMESPACE = "covrecon/m"
ADMITTED = (
    "router.1",
    "ground.2",
    "sim.1",
    "drone-1.1",
    "drone-1.2",
    "drone-2.1",
    "drone-9.1",
    "operator-anna.1",
    "mapper.1",
    "mocap.1",
)
DRONES = {1, 2}
PARTY = {
    "ground": "ground",
    "sim": "sim",
    "drone-1": "agent",
    "operator-anna": "operator",
    "mapper": "mapper",
    "mocap": "mocap",
}
each_topic = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
each_identity = pytest.mark.parametrize("identity", PARTY)


@pytest.fixture(scope="module")
def control() -> Mapping[str, Any]:
    return access_control(NAMESPACE, DRONES, ADMITTED)


def allows(control: Mapping[str, Any], identity: str, message: str, flow: str, key: str) -> bool:
    """As zenoh judges: a rule's key must include the message's whole key."""
    rules = {rule["id"]: rule for rule in control["rules"]}
    wanted = zenoh.KeyExpr(f"{NAMESPACE}/{key}")
    return any(
        message in rules[name]["messages"]
        and flow in rules[name]["flows"]
        and any(zenoh.KeyExpr(expression).includes(wanted) for expression in rules[name]["key_exprs"])
        for policy in control["policies"]
        if identity in policy["subjects"]
        for name in policy["rules"]
    )


def test_what_no_rule_allows_is_denied(control: Mapping[str, Any]) -> None:
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    assert all(rule["permission"] == "allow" for rule in control["rules"])


@each_topic
@each_identity
def test_only_its_writers_put_a_topic(control: Mapping[str, Any], topic: Topic[Message], identity: str) -> None:
    writes = not topic.queryable and PARTY[identity] in topic.writers
    assert allows(control, identity, "put", "ingress", topic.of(1)) is writes


@each_topic
@each_identity
def test_only_its_readers_hear_a_topic(control: Mapping[str, Any], topic: Topic[Message], identity: str) -> None:
    hears = not topic.queryable and PARTY[identity] in topic.readers
    assert allows(control, identity, "declare_subscriber", "ingress", topic.of("*")) is hears
    assert allows(control, identity, "put", "egress", topic.of(2)) is hears


@each_topic
@each_identity
def test_only_its_readers_ask_and_only_its_writers_answer(
    control: Mapping[str, Any], topic: Topic[Message], identity: str
) -> None:
    asks = topic.queryable and PARTY[identity] in topic.readers
    answers = topic.queryable and PARTY[identity] in topic.writers
    assert allows(control, identity, "query", "ingress", topic.of(2)) is asks
    assert allows(control, identity, "reply", "egress", topic.of(2)) is asks
    for message in ("declare_queryable", "reply"):
        assert allows(control, identity, message, "ingress", topic.of(1)) is answers
    assert allows(control, identity, "query", "egress", topic.of(1)) is answers


@each_topic
def test_a_drone_writes_no_other_drones_keys(control: Mapping[str, Any], topic: Topic[Message]) -> None:
    if "{drone}" in topic.key:
        for message in ("put", "declare_queryable", "reply"):
            assert not allows(control, "drone-1", message, "ingress", topic.of(2))
            assert not allows(control, "drone-1", message, "ingress", topic.of("*"))


def test_each_process_lives_under_its_own_name_alone(control: Mapping[str, Any]) -> None:
    roles = {"ground": "ground", "sim": "sim", "drone-1": "drone/1", "drone-2": "drone/2"}
    roles |= {"mapper": "mapper", "mocap": "mocap"}
    for identity in (*roles, "operator-anna"):
        for role in roles.values():
            alone = roles.get(identity) == role
            assert allows(control, identity, "liveliness_token", "ingress", alive_key(role)) is alone
        assert not allows(control, identity, "liveliness_token", "ingress", alive_key("**"))


@pytest.mark.parametrize("message", ["declare_liveliness_subscriber", "liveliness_query"])
@each_identity
def test_everybody_may_see_who_lives(control: Mapping[str, Any], message: str, identity: str) -> None:
    assert allows(control, identity, message, "ingress", alive_key("**"))
    assert allows(control, identity, "liveliness_token", "egress", alive_key("drone/2"))


@each_identity
def test_nobody_deletes_and_nobody_hears_another_mission(control: Mapping[str, Any], identity: str) -> None:
    assert not any("delete" in rule["messages"] for rule in control["rules"])
    assert all(key.startswith(f"{NAMESPACE}/") for rule in control["rules"] for key in rule["key_exprs"])
    assert not allows(control, identity, "declare_subscriber", "ingress", "**")


def test_a_subject_has_all_admitted_issues_of_its_certificate(control: Mapping[str, Any]) -> None:
    subjects = {subject["id"]: subject["cert_common_names"] for subject in control["subjects"]}
    assert subjects["drone-1"] == ["drone-1.1", "drone-1.2"]
    assert subjects["ground"] == ["ground.2"]


def test_a_drone_that_is_not_in_the_mission_may_do_nothing(control: Mapping[str, Any]) -> None:
    assert "drone-9" not in {subject["id"] for subject in control["subjects"]}


@each_topic
def test_another_router_passes_everything_on_but_no_deletes(control: Mapping[str, Any], topic: Topic[Message]) -> None:
    for flow in ("ingress", "egress"):
        for message in ("put", "query", "reply", "declare_subscriber", "declare_queryable"):
            assert allows(control, "router", message, flow, topic.of(2))


def test_without_any_certificate_there_are_no_rules_and_all_is_denied() -> None:
    nobody = access_control(NAMESPACE, DRONES, ())
    assert (nobody["rules"], nobody["subjects"], nobody["policies"]) == ([], [], [])
    assert nobody["default_permission"] == "deny"
