"""Who may do what on the bus: zenoh's access control, made from the table of topics. What is not allowed is denied.

The router applies it to each link by the common name of its certificate (`protocol.credentials`). So a drone writes its
own keys and no other's, only the ground station writes phi and the mission's phase, and a certificate that the register
does not admit - revoked, expired, of no mission - may do nothing at all.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Any

from protocol.credentials import GROUND, MAPPER, MOCAP, ROUTER, SIM, identity_of_name
from protocol.topics import TOPICS, Party, Topic, alive_key
from protocol.wire import Message

PASSING = (
    "put", "query", "reply", "declare_subscriber", "declare_queryable",
    "liveliness_token", "declare_liveliness_subscriber", "liveliness_query",
)  # fmt: skip
"""All that this program makes of zenoh; nobody deletes."""

Rule = dict[str, Any]


def access_control(namespace: str, drones: Collection[int], admitted: Iterable[str]) -> dict[str, Any]:
    """zenoh's ``access_control`` of a mission's router.

    Args:
        namespace: of the mission's keys.
        drones: ids of those in the mission; the certificate of another drone opens nothing.
        admitted: common names of certificates that are neither revoked nor expired.
    """
    names: dict[str, list[str]] = {}
    for name in admitted:
        names.setdefault(identity_of_name(name), []).append(name)
    rules: list[Rule] = []
    subjects: list[Rule] = []
    policies: list[Rule] = []
    for identity, common_names in sorted(names.items()):
        own = _rules_of(identity, drones)
        if own:
            rules += [_under(namespace, rule) for rule in own]
            subjects.append({"id": identity, "cert_common_names": common_names})
            policies.append({"rules": [rule["id"] for rule in own], "subjects": [identity]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules_of(identity: str, drones: Collection[int]) -> list[Rule]:
    kind, _, rest = identity.partition("-")
    if identity == ROUTER:  # another site's or a second one: it judged already what it passes on
        return [_rule(identity, "passing", PASSING, ("ingress", "egress"), ["**"])]
    if identity == GROUND:
        return list(_party(identity, "ground", "", "ground"))
    if identity == SIM:
        return list(_party(identity, "sim", "*", "sim"))
    if identity == MAPPER:
        return list(_party(identity, "mapper", "", "mapper"))
    if identity == MOCAP:
        return list(_party(identity, "mocap", "*", "mocap"))
    if kind == "drone" and int(rest) in drones:
        return list(_party(identity, "agent", rest, f"drone/{rest}"))
    if kind == "operator":
        return list(_party(identity, "operator", "", ""))
    return []


def _party(identity: str, party: Party, drone: str, role: str) -> Iterator[Rule]:
    """Rules of one process.

    Args:
        party: what it is in the table of topics.
        drone: whose keys it writes, ``*`` for those of all.
        role: of its liveliness token; empty: it has none.
    """

    def rule(name: str, messages: Iterable[str], flows: Iterable[str], keys: Iterable[str]) -> Iterator[Rule]:
        listed = sorted(set(keys))
        if listed:
            yield _rule(identity, name, messages, flows, listed)

    written = [topic.of(drone) for topic in _topics(party, written=True)]
    heard = [topic.of("*") for topic in _topics(party, written=False)]
    answered = [topic.of(drone) for topic in _topics(party, written=True, queryable=True)]
    asked = [topic.of("*") for topic in _topics(party, written=False, queryable=True)]
    lives = [alive_key("**")]
    yield from rule("writes", ["put"], ["ingress"], written)
    yield from rule("subscribes", ["declare_subscriber"], ["ingress"], heard)
    yield from rule("hears", ["put"], ["egress"], heard)
    yield from rule("answers", ["declare_queryable", "reply"], ["ingress"], answered)
    yield from rule("is asked", ["query"], ["egress"], answered)
    yield from rule("asks", ["query"], ["ingress"], asked)
    yield from rule("is answered", ["reply"], ["egress"], asked)
    yield from rule("lives", ["liveliness_token"], ["ingress"], [alive_key(role)] if role else [])
    yield from rule("watches lives", ["declare_liveliness_subscriber", "liveliness_query"], ["ingress"], lives)
    yield from rule("sees lives", ["liveliness_token", "put", "reply"], ["egress"], lives)
    # Who listens and who answers is no secret, and without it zenoh sends nothing.
    yield from rule("knows", ["declare_subscriber", "declare_queryable"], ["egress"], ["**"])


def _topics(party: Party, *, written: bool, queryable: bool = False) -> Iterator[Topic[Message]]:
    for topic in TOPICS:
        if topic.queryable == queryable and party in (topic.writers if written else topic.readers):
            yield topic


def _rule(identity: str, name: str, messages: Iterable[str], flows: Iterable[str], keys: list[str]) -> Rule:
    return {
        "id": f"{identity} {name}",
        "messages": list(messages),
        "flows": list(flows),
        "permission": "allow",
        "key_exprs": keys,
    }


def _under(namespace: str, rule: Rule) -> Rule:
    return {**rule, "key_exprs": [f"{namespace}/{key}" for key in rule["key_exprs"]]}
