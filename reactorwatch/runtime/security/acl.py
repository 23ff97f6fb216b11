"""Who may say what on the bus: the roles, and the access rules that a router enforces for them.

Everyone has a certificate, and its common name says the plant and the role: `cstr.monitor`. What a rule does not allow
is refused, silently, so that who is refused sees nothing but silence (`reactorwatch doctor` tells the difference).

A router looks at each message twice, when it comes in and when it goes out. Speaking is allowed where it comes in;
hearing is allowed at both: a subscription that is wider than the rule is not let in, and nothing of another plant goes
out. What publishers remember is asked for below `@adv`, which no `**` reaches, and has keys of its own in each rule.

Source of the words: https://zenoh.io/docs/manual/access-control
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from reactorwatch.contract import keys

MEMORY = "@adv/**"
"""Below a key: where Zenoh's publishers answer for what they remember of it."""
NOBODY = f"{keys.ROOT}watch/nobody"
"""A key that no queryable answers: a question to it comes back when all before it is through. Everyone may ask it."""

PLANT_COMMANDS = ("set_input", "inject_fault", "clear_fault", "pause", "resume", "step", "set_rate")
"""What the plant, or a replay in its place, is told."""
OF_THE_PLANT = ("acknowledge", "shelve", "unshelve", "comment")
ALARM_COMMANDS = (*OF_THE_PLANT, keys.ACKNOWLEDGE_RECORDER)
"""What an operator does with alarms, those of the plant and the recorder's own."""
ALARM_ENGINEERING = ("suppress", "unsuppress", "take_out_of_service", "return_to_service")
"""What needs more than an operator: alarms that nobody then sees until somebody brings them back."""
LISTS = ("list_alarms", keys.LIST_RECORDER_ALARMS)
"""Questions that change nothing."""


@dataclass(frozen=True)
class Role:
    """What the holder of a certificate may do beyond reading its plant.

    Attributes:
        name: the second part of the common name.
        nodes: the nodes that run with it, each of which says that it is alive and how it does.
        publishes: below the plant's key, such as `sample/**`.
        answers: the commands it listens to, and keeps a record of.
        asks: the commands it may give.
    """

    name: str
    nodes: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    asks: tuple[str, ...] = LISTS

    @property
    def key_space(self) -> tuple[str, ...]:
        """Key expressions, below the plant's key, of all that it may publish."""
        health = (f"{keys.HEALTH}/{node}" for node in self.nodes)
        audit = (f"{keys.AUDIT}/{command}" for command in self.answers)
        return (*self.publishes, *health, *audit)


PROOF = "@doctor/**"
"""Below a kind: where `doctor` publishes to see whether it is heard; nobody else hears it, for no `**` reaches it."""

ROLES = (
    Role("plant", ("plant", "replay"), (f"{keys.SAMPLE}/**", f"{keys.FAULT}/**"), answers=PLANT_COMMANDS),
    Role(
        "monitor",
        ("monitor", "diagnosis"),
        (
            *(f"{kind}/**" for kind in (keys.ESTIMATE, keys.MODEL, keys.CHART, keys.ALARM, keys.RECONSTRUCTION)),
            f"{keys.ALARM_KPIS}/monitor",
        ),
        answers=(*OF_THE_PLANT, *ALARM_ENGINEERING, "list_alarms"),
    ),
    Role(
        "recorder",
        ("recorder",),
        (f"{keys.ALARM}/{keys.RECORDING}/**",),
        answers=(keys.ACKNOWLEDGE_RECORDER, keys.LIST_RECORDER_ALARMS),
    ),
    Role("operator", asks=(*LISTS, *ALARM_COMMANDS)),
    Role("engineer", asks=(*LISTS, *ALARM_COMMANDS, *ALARM_ENGINEERING, *PLANT_COMMANDS)),
    Role("viewer"),
)
"""Everyone that a certificate can be made for, but the router."""

REVOKED = "revoked"
"""The subject of certificates that may do nothing: Zenoh 1.10 reads no revocation lists of certificates."""
SERIAL_BYTES = 4
_SERIAL = re.compile(rf"\.[0-9a-f]{{{2 * SERIAL_BYTES}}}$")
NO_NAMES: Mapping[str, str] = MappingProxyType({})
EVERY_MESSAGE = (
    *("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)

HEAR_IN = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
HEAR_OUT = ("put", "delete", "reply", "liveliness_token", "declare_queryable", "declare_subscriber")


def common_name(plant: str, role: str) -> str:
    """What a certificate calls its holder.

    >>> common_name("cstr", "viewer")
    'cstr.viewer'
    """
    return f"{plant}.{role}"


def kinds_of(role: Role) -> tuple[str, ...]:
    """What a role publishes, by kind: the first part of its keys, such as `sample`."""
    return tuple(dict.fromkeys(key.split("/")[0] for key in role.publishes))


def role_of(name: str) -> tuple[str, Role] | None:
    """The plant and the role that a common name says; None if it says none.

    >>> role_of("line.2.viewer")[0]
    'line.2'
    >>> role_of("line.2.viewer.0f3a9c21")[0]
    'line.2'
    >>> role_of("router") is None
    True
    """
    plant, _, word = _SERIAL.sub("", name).rpartition(".")
    return next(((plant, role) for role in ROLES if plant and role.name == word), None)


def access_control(
    plants: tuple[str, ...], names: Mapping[str, str] = NO_NAMES, revoked: Sequence[str] = ()
) -> dict[str, Any]:
    """A router's settings `access_control`: nothing is allowed but what the roles of these plants may do.

    A key is published on by one role alone (see `streams`): where a role's expression also names keys of another, these
    are denied to it, which goes before what is allowed.

    Args:
        plants: their names.
        names: the common name of a holder's certificates, by `plant/role`; those not named have `common_name`.
        revoked: common names of certificates that may do nothing. The list is in the settings under `subjects`.
    """
    rules: list[dict[str, Any]] = [_rule("everyone", "ask nobody", ("ingress",), ("query",), [NOBODY])]
    subjects, policies = [], []
    for plant in plants:
        root = f"{keys.ROOT}/{plant}"
        monitors = keys.monitor_token(plant, "*")
        everything = [f"{root}/**", f"{root}/**/{MEMORY}", f"{root}/*/{PROOF}", monitors, keys.FLEET_TOKENS]
        reading = [
            _rule(plant, "hear", ("ingress",), HEAR_IN, everything),
            _rule(plant, "be told", ("egress",), HEAR_OUT, everything),
            _rule(plant, "ask what is remembered", ("ingress",), ("query",), everything[1:2]),
        ]
        rules += reading
        for role in ROLES:
            name = common_name(plant, role.name)
            asks = [f"{root}/{keys.COMMAND}/{command}" for command in role.asks]
            own = [_rule(name, "ask", ("ingress",), ("query",), asks)]
            if role.nodes:
                said = [f"{root}/{expression}" for expression in role.key_space]
                memory = [f"{key}/{MEMORY}" for key in said]
                proofs = [f"{root}/{kind}/{PROOF}" for kind in kinds_of(role)]
                answers = [f"{root}/{keys.COMMAND}/{command}" for command in role.answers]
                alive = [f"{root}/{keys.ALIVE}/{node}" for node in role.nodes]
                alive += [monitors] if role.name == "monitor" else []
                own += [
                    _rule(name, "publish", ("ingress",), ("put", "reply"), [*said, *memory, *proofs]),
                    _rule(name, "remember", ("ingress",), ("declare_queryable", "liveliness_token"), memory),
                    _rule(name, "answer", ("ingress",), ("declare_queryable", "reply"), answers),
                    _rule(name, "be alive", ("ingress",), ("liveliness_token",), alive),
                    _rule(name, "be asked", ("egress",), ("query",), [*everything[1:2], *answers]),
                    _rule(name, "know who listens", ("egress",), ("declare_liveliness_subscriber",), everything),
                ]
                others = [f"{root}/{expression}" for expression in key_space_of_others(role)]
                if others:
                    own.append(
                        _rule(
                            name,
                            "leave to others",
                            ("ingress",),
                            ("put", "delete", "reply", "declare_queryable", "liveliness_token"),
                            [*others, *(f"{key}/{MEMORY}" for key in others)],
                            permission="deny",
                        )
                    )
            rules += own
            subjects.append({"id": name, "cert_common_names": [names.get(f"{plant}/{role.name}", name)]})
            used = [rules[0], *reading, *own]
            policies.append({"rules": [rule["id"] for rule in used], "subjects": [name]})
    if revoked:
        nothing = _rule(REVOKED, "nothing", ("ingress", "egress"), EVERY_MESSAGE, ["**", f"**/{MEMORY}"])
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
    """Key expressions of other roles that lie within a role's own expressions; no other role may publish there.

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
    who: str,
    what: str,
    flows: tuple[str, ...],
    messages: tuple[str, ...],
    key_expressions: list[str],
    *,
    permission: str = "allow",
) -> dict[str, Any]:
    return {
        "id": f"{who}: {what}",
        "permission": permission,
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": key_expressions,
    }
