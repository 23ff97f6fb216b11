"""In a site each role finds another instance of its nodes, and no client without the role can forge one."""

from typing import TYPE_CHECKING

import pytest

from reactorwatch.contract import keys
from reactorwatch.runtime.acl import ROLES
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.start import claim_name

if TYPE_CHECKING:
    from .site import Site

NODES = [(role.name, node) for role in ROLES for node in role.nodes]


@pytest.mark.parametrize(("role", "node"), NODES)
def test_the_token_of_an_instance_is_seen_by_the_next_of_its_role_alone(site: "Site", role: str, node: str) -> None:
    own, feigned = (keys.instance_token("cstr", node, f"{name}.12@pi4") for name in "ab")
    other = next(name for name, _ in NODES if name != role)
    site.join(f"cstr/{other}").declare_token(feigned)
    assert claim_name(site.join(f"cstr/{role}"), node, own, StopSignal())
    assert site.join(f"cstr/{role}").query_tokens(keys.instance_token("cstr", node, "*")) == [own]
