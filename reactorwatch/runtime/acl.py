"""Access control: roles, and the rules that a router enforces for them.

Each client has a certificate whose common name holds plant and role: `cstr.monitor`; that of a client for all plants of
a site is `@fleet.monitor`. A message that no rule allows is refused silently (`reactorwatch doctor` finds refusals).

A router checks each message at ingress and at egress. Publishing is allowed at ingress; reading is allowed at both: a
subscription wider than the rule is refused, and no message of another plant goes out. Publishers' caches are queried
below `@adv`, which no `**` matches, and have keys of their own in each rule.

Source of the terms: https://zenoh.io/docs/manual/access-control
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from google.protobuf import text_format

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Audit, BaselineCommand, CommandReply, ListAlarms

CACHE_SUFFIX = "@adv/**"
"""Part below a key at which Zenoh's publishers answer queries of their caches."""
NO_QUERYABLE = f"{keys.ROOT}watch/nobody"
"""Key without a queryable: a query of it ends when all messages before it have arrived. Every role may query it."""

FLEET = keys.FLEET.removeprefix("@")
"""Stands in place of a plant for all plants of a site."""

PLANT_COMMANDS = ("set_input", "inject_fault", "clear_fault")
"""Commands of the plant."""
PLANT_ALARM_COMMANDS = ("acknowledge", "shelve", "unshelve", "comment")
ALARM_COMMANDS = (*PLANT_ALARM_COMMANDS, keys.ACKNOWLEDGE_RECORDER)
"""Commands of an operator for alarms of the plant and of the recorder."""
ALARM_ENGINEERING = ("suppress", "unsuppress", "take_out_of_service", "return_to_service")
"""Commands of an engineer: they hide alarms until a second command shows them again."""
BASELINE_COMMANDS = ("baseline",)
"""Commands of an engineer: they change what a plant is judged by."""
LISTS = ("list_alarms", keys.LIST_RECORDER_ALARMS)
"""Commands that change nothing."""


@dataclass(frozen=True)
class Role:
    """Rights of the holder of a certificate, beyond reading its plant.

    Attributes:
        name: the second part of the common name.
        nodes: names of the nodes with this role; each shows a liveliness token and publishes its health.
        publishes: key expressions below the plant's key, such as `sample/**`.
        answers: names of the commands that it executes, and publishes a record of.
        asks: names of the commands that it may give.
    """

    name: str
    nodes: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    asks: tuple[str, ...] = LISTS

    @property
    def key_space(self) -> tuple[str, ...]:
        """Key expressions, below the plant's key, of all that the role may publish."""
        health = (f"{keys.HEALTH}/{node}" for node in self.nodes)
        audit = (f"{keys.AUDIT}/{command}" for command in self.answers)
        return (*self.publishes, *health, *audit)


PROOF = "@doctor/**"
"""Part below a kind on which `doctor` publishes to test its rights; no other subscriber matches it."""

ROLES = (
    Role("plant", ("plant", "replay"), (f"{keys.SAMPLE}/**", f"{keys.FAULT}/**"), answers=PLANT_COMMANDS),
    Role(
        "monitor",
        ("monitor", "diagnosis"),
        (
            *(f"{kind}/**" for kind in (keys.ESTIMATE, keys.MODEL, keys.CHART, keys.RECONSTRUCTION)),
            *(f"{kind}/**" for kind in (keys.ALARM, keys.INCIDENT)),
            f"{keys.ALARM_KPIS}/monitor",
            f"{keys.BASELINE}/monitor",
            f"{keys.PROMISE}/monitor",
        ),
        answers=(*PLANT_ALARM_COMMANDS, *ALARM_ENGINEERING, *BASELINE_COMMANDS, "list_alarms"),
    ),
    Role(
        "recorder",
        ("recorder",),
        (f"{keys.ALARM}/{keys.RECORDING}/**",),
        answers=(keys.ACKNOWLEDGE_RECORDER, keys.LIST_RECORDER_ALARMS),
    ),
    Role("operator", asks=(*LISTS, *ALARM_COMMANDS)),
    Role("engineer", asks=(*LISTS, *ALARM_COMMANDS, *ALARM_ENGINEERING, *BASELINE_COMMANDS, *PLANT_COMMANDS)),
    Role("viewer"),
)
"""All roles with certificates, except the router."""

REVOKED = "revoked"
"""Subject of the rules for revoked certificates: Zenoh 1.10 reads no certificate revocation lists."""
SERIAL_BYTES = 4  # at the end of a certificate's name: four billion of a role
_SERIAL = re.compile(rf"\.[0-9a-f]{{{2 * SERIAL_BYTES}}}$")
NO_NAMES: Mapping[str, str] = MappingProxyType({})
EVERY_MESSAGE = (
    *("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)

READ_INGRESS = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
READ_EGRESS = ("put", "delete", "reply", "liveliness_token", "declare_queryable", "declare_subscriber")


def common_name(plant: str, role: str) -> str:
    """Common name of a holder's certificate.

    >>> common_name("cstr", "viewer"), common_name(FLEET, "viewer")
    ('cstr.viewer', '@fleet.viewer')
    """
    return f"{keys.FLEET if plant == FLEET else plant}.{role}"


def roles_of(plant: str) -> tuple[Role, ...]:
    """Roles with certificates for a plant, or for all: none publishes samples in the name of every plant."""
    return tuple(role for role in ROLES if plant != FLEET or role.name != "plant")


def kinds_of(role: Role) -> tuple[str, ...]:
    """Kinds that a role publishes: the first part of its keys, such as `sample`."""
    return tuple(dict.fromkeys(key.split("/")[0] for key in role.publishes))


def parse_common_name(name: str) -> tuple[str, Role] | None:
    """Plant and role in a common name; None if it is malformed.

    >>> parse_common_name("line.2.viewer")[0]
    'line.2'
    >>> parse_common_name("line.2.viewer.0f3a9c21")[0]
    'line.2'
    >>> parse_common_name("router") is None
    True
    """
    plant, _, word = _SERIAL.sub("", name).rpartition(".")
    return next(((plant, role) for role in ROLES if plant and role.name == word), None)


def access_control(
    plants: tuple[str, ...], names: Mapping[str, str] = NO_NAMES, revoked: Sequence[str] = ()
) -> dict[str, Any]:
    """A router's settings `access_control`, which allow only the rights of these plants' roles.

    Only one role publishes on a key (see `streams`): where a role's expression also matches keys of another, a rule
    denies them, which takes precedence.

    A publisher sends nothing before it knows of a subscriber, and no rule of a plant matches a subscription or a query
    to all plants. So where clients for all plants exist, these reach the clients of each plant.

    Args:
        plants: names of the plants; `FLEET`: clients for all plants.
        names: common names of holders' certificates, by `plant/role`, where they differ from `common_name`.
        revoked: common names of certificates without any rights, listed in the settings under `subjects`.
    """
    common = [_rule("everyone", "end of history", ("ingress",), ("query",), [NO_QUERYABLE])]
    if FLEET in plants:
        all_plants = [f"{keys.ROOT}/*/**", f"{keys.ROOT}/*/**/{CACHE_SUFFIX}"]
        common += [
            _rule("everyone", "see subscribers to all plants", ("egress",), ("declare_subscriber",), all_plants),
            _rule("everyone", "receive their queries", ("egress",), ("query",), all_plants[1:]),
        ]
    rules: list[dict[str, Any]] = [*common]
    subjects, policies = [], []
    for plant in plants:
        pattern = "*" if plant == FLEET else plant
        root = f"{keys.ROOT}/{pattern}"
        instances = {node: keys.instance_token(pattern, node, "*") for role in ROLES for node in role.nodes}
        others = [f"{root}/*/{PROOF}", *instances.values(), keys.FLEET_TOKENS]
        everything = [f"{root}/**", f"{root}/**/{CACHE_SUFFIX}", *others]
        reading = [
            _rule(plant, "subscribe", ("ingress",), READ_INGRESS, everything),
            _rule(plant, "receive", ("egress",), READ_EGRESS, everything),
            _rule(plant, "query caches", ("ingress",), ("query",), everything[1:2]),
        ]
        rules += reading
        for role in roles_of(plant):
            name = common_name(plant, role.name)
            asks = [f"{root}/{keys.COMMAND}/{command}" for command in role.asks]
            own = [_rule(name, "command", ("ingress",), ("query",), asks)]
            if role.nodes:
                published = [f"{root}/{expression}" for expression in role.key_space]
                caches = [f"{key}/{CACHE_SUFFIX}" for key in published]
                proofs = [f"{root}/{kind}/{PROOF}" for kind in kinds_of(role)]
                answers = [f"{root}/{keys.COMMAND}/{command}" for command in role.answers]
                alive = [f"{root}/{keys.ALIVE}/{node}" for node in role.nodes]
                alive += [instances[node] for node in role.nodes]
                alive += [keys.FLEET_TOKENS] if plant == FLEET and role.name == "monitor" else []
                own += [
                    _rule(name, "publish", ("ingress",), ("put", "reply"), [*published, *caches, *proofs]),
                    _rule(name, "cache", ("ingress",), ("declare_queryable", "liveliness_token"), caches),
                    _rule(name, "answer", ("ingress",), ("declare_queryable", "reply"), answers),
                    _rule(name, "declare token", ("ingress",), ("liveliness_token",), alive),
                    _rule(name, "receive queries", ("egress",), ("query",), [*everything[1:2], *answers]),
                    _rule(name, "see subscribers", ("egress",), ("declare_liveliness_subscriber",), everything),
                ]
                others = [f"{root}/{expression}" for expression in key_space_of_others(role)]
                if others:
                    own.append(
                        _rule(
                            name,
                            "leave to others",
                            ("ingress",),
                            ("put", "delete", "reply", "declare_queryable", "liveliness_token"),
                            [*others, *(f"{key}/{CACHE_SUFFIX}" for key in others)],
                            permission="deny",
                        )
                    )
            rules += own
            subjects.append({"id": name, "cert_common_names": [names.get(f"{plant}/{role.name}", name)]})
            used = [*common, *reading, *own]
            policies.append({"rules": [rule["id"] for rule in used], "subjects": [name]})
    if revoked:
        nothing = _rule(REVOKED, "nothing", ("ingress", "egress"), EVERY_MESSAGE, ["**", f"**/{CACHE_SUFFIX}"])
        rules.append({**nothing, "permission": "deny"})
        subjects.append({"id": REVOKED, "cert_common_names": list(revoked)})
        policies.append({"rules": [nothing["id"]], "subjects": [REVOKED]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def key_space_of_others(role: Role) -> tuple[str, ...]:
    """Key expressions of other roles within a role's own expressions, on which it may not publish.

    >>> [key_space_of_others(role) for role in ROLES if role.name == "monitor"]
    [('alarm/recording/**',)]
    """
    return tuple(
        narrow
        for other in ROLES
        if other is not role
        for narrow in other.publishes
        for wide in role.publishes
        if narrow != wide and wide.endswith("/**") and narrow.startswith(wide.removesuffix("**"))
    )


def _rule(
    holder: str,
    what: str,
    flows: tuple[str, ...],
    messages: tuple[str, ...],
    key_expressions: list[str],
    *,
    permission: str = "allow",
) -> dict[str, Any]:
    return {
        "id": f"{holder}: {what}",
        "permission": permission,
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": key_expressions,
    }


def is_query(question: Encoded) -> bool:
    """True for a command that asks for something and changes nothing."""
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        return False
    return isinstance(command, ListAlarms) or (isinstance(command, BaselineCommand) and command.what == "list")


def audit(question: Encoded, reply: CommandReply, now_ns: int) -> Publication | None:
    """Make the record of a command and its reply; None for a command that changes nothing, or on an unknown key.

    The sender's name is the one in the command. The router's access rules ensure that a client with the right to give
    it did; they cannot identify the person.

    Args:
        question: the encoded command.
        reply: the node's reply.
        now_ns: time of the reply.
    """
    topic = keys.parse(question.key)
    if topic is None or topic.kind != keys.COMMAND or is_query(question):
        return None
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        command = None  # the reply holds the error
    record = Audit(
        time_ns=now_ns,
        command=topic.name,
        by=str(getattr(command, "by", "")),
        accepted=reply.accepted,
        text=reply.text,
        request="" if command is None else text_format.MessageToString(command, as_one_line=True),
    )
    return Publication(keys.key(topic.plant, keys.AUDIT, topic.name), record)
