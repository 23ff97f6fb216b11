"""The Kubernetes manifests: valid in the newest two versions, with least rights, and true to the image."""

import copy
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from monitor_node.fleet import parse_shard
from tests.manifests import PLAIN, ROOT, SECURE, Manifest, build, container, environments, identity, pod, workloads

VERSIONS = tuple(dict.fromkeys(kubernetes_validate.utils.all_versions()))[-2:]
FOLDERS = (PLAIN, SECURE)
NODES = ("recorder", "monitor")
NAMES = {"router", *NODES}

both = pytest.mark.parametrize("folder", FOLDERS, ids=["plain", "secure"])


def every_container(folder: Path) -> Iterator[tuple[str, Manifest, Manifest]]:
    """Workload's name, workload and container."""
    for name, workload in workloads(folder).items():
        for one in (*pod(workload).get("initContainers", []), *pod(workload)["containers"]):
            yield name, workload, one


def selects(selector: Manifest, labels: dict[str, str]) -> bool:
    """True if a selector takes in a pod with these labels."""
    assert selector.keys() <= {"matchLabels", "matchExpressions"}
    for rule in selector.get("matchExpressions", []):
        assert rule["operator"] == "NotIn"
        if labels.get(rule["key"]) in rule["values"]:
            return False
    return bool(selector.get("matchLabels", {}).items() <= labels.items())


def policies(folder: Path, labels: dict[str, str], direction: str) -> list[Manifest]:
    """Rules of all policies on a pod in a direction; at least one policy must be on it."""
    specs = [item["spec"] for item in build(folder) if item["kind"] == "NetworkPolicy"]
    on_pod = [item for item in specs if selects(item["podSelector"], labels) and direction in item["policyTypes"]]
    assert on_pod, f"{labels}: nothing is refused"
    return [rule for item in on_pod for rule in item.get(direction.lower(), [])]


def as_list_of_items(value: Any) -> Any:
    """A value with its lists of objects in an order that depends on nothing but the objects."""
    if isinstance(value, dict):
        return {key: as_list_of_items(item) for key, item in value.items()}
    if isinstance(value, list):
        items = [as_list_of_items(item) for item in value]
        return sorted(items, key=partial(json.dumps, sort_keys=True)) if items and isinstance(items[0], dict) else items
    return value


# --- form ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
@both
def test_every_object_is_valid_and_has_no_unknown_key(folder: Path, version: str) -> None:
    for item in build(folder):
        kubernetes_validate.validate(item, version, strict=True)


@pytest.mark.parametrize("path", ["spec", "spec.template.spec", "spec.template.spec.containers.0.securityContext"])
def test_a_key_that_kubernetes_does_not_know_is_found(path: str) -> None:
    wrong = copy.deepcopy(workloads(PLAIN)["monitor"])
    inner: Any = wrong
    for part in path.split("."):
        inner = inner[int(part) if part.isdecimal() else part]
    inner["readonlyRootFilesystem"] = True
    with pytest.raises(kubernetes_validate.ValidationError, match="readonlyRootFilesystem"):
        kubernetes_validate.validate(wrong, VERSIONS[-1], strict=True)


@both
def test_kubectl_makes_the_same_of_the_patches(folder: Path) -> None:
    program = shutil.which("kubectl")
    if program is None:
        pytest.skip("kubectl is not installed")
    done = subprocess.run([program, "kustomize", str(folder)], check=True, capture_output=True, text=True)
    expected = {identity(item): as_list_of_items(item) for item in yaml.safe_load_all(done.stdout)}
    assert {identity(item): as_list_of_items(item) for item in build(folder)} == expected


@both
def test_every_object_is_in_whatever_namespace_it_is_applied_to(folder: Path) -> None:
    assert set(workloads(folder)) == NAMES
    for item in build(folder):
        assert "namespace" not in item["metadata"], identity(item)


@both
def test_what_is_selected_exists(folder: Path) -> None:
    labels = {name: item["spec"]["template"]["metadata"]["labels"] for name, item in workloads(folder).items()}
    for item in build(folder):
        if item["kind"] in ("Deployment", "StatefulSet", "PodDisruptionBudget"):
            name = item["metadata"]["name"]
            chosen = [other for other, its in labels.items() if selects(item["spec"]["selector"], its)]
            assert chosen == [name], identity(item)
        if item["kind"] == "Service":
            ports = [port["name"] for port in container(workloads(folder)["router"])["ports"]]
            assert [name for name, its in labels.items() if item["spec"]["selector"].items() <= its.items()] == [
                "router"
            ]
            assert [(port["port"], port["targetPort"]) for port in item["spec"]["ports"]] == [(7447, *ports)]
    (spread,) = pod(workloads(folder)["monitor"])["topologySpreadConstraints"]
    assert selects(spread["labelSelector"], labels["monitor"])
    assert spread["topologyKey"] == "kubernetes.io/hostname"


# --- rights -------------------------------------------------------------------------------------------------------


@both
def test_every_container_has_least_rights_and_limits(folder: Path) -> None:
    for name, workload, one in every_container(folder):
        assert one["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }, name
        for resource in ("cpu", "memory"):
            assert resource in one["resources"]["requests"], name
            assert resource in one["resources"]["limits"], name
        own, rights = pod(workload), pod(workload)["securityContext"]
        assert own["automountServiceAccountToken"] is False, name
        assert own["terminationGracePeriodSeconds"] == 30, name
        assert not {"hostNetwork", "hostPID", "hostIPC"} & own.keys(), name
        assert rights["runAsNonRoot"] is True, name
        assert rights["seccompProfile"] == {"type": "RuntimeDefault"}, name
        assert f"--uid {rights['runAsUser']} " in (ROOT / "Dockerfile").read_text(encoding="utf-8"), name
        assert rights["runAsUser"] == rights["runAsGroup"] == rights["fsGroup"], name


@both
def test_images_have_versions(folder: Path) -> None:
    for name, _, one in every_container(folder):
        assert re.search(r":\d+\.\d+\.\d+(\.dev\d+)?(@sha256:[0-9a-f]{64})?$", one["image"]), name


@both
def test_the_nodes_reach_the_router_and_names_and_only_they_reach_the_router(folder: Path) -> None:
    labels = {name: item["spec"]["template"]["metadata"]["labels"] for name, item in workloads(folder).items()}
    for name in NODES:
        assert policies(folder, labels[name], "Ingress") == []
        to_router, to_names = policies(folder, labels[name], "Egress")
        assert [other for other, its in labels.items() if selects(to_router["to"][0]["podSelector"], its)] == ["router"]
        assert [port["port"] for port in to_router["ports"]] == [7447]
        assert {(port["protocol"], port["port"]) for port in to_names["ports"]} == {("UDP", 53), ("TCP", 53)}
        assert len(to_router["to"]) == len(to_names["to"]) == 1
    assert policies(folder, labels["router"], "Egress") == []
    (entry,) = policies(folder, labels["router"], "Ingress")
    (from_pods,) = entry["from"]
    assert from_pods.keys() == {"podSelector"}
    assert all(selects(from_pods["podSelector"], its) for its in labels.values())
    assert not selects(from_pods["podSelector"], {"app.kubernetes.io/name": "router"})
    assert [port["port"] for port in entry["ports"]] == [7447]


# --- files --------------------------------------------------------------------------------------------------------


@both
def test_what_a_container_writes_is_on_a_volume(folder: Path) -> None:
    for name, workload, one in every_container(folder):
        claims = [claim["metadata"]["name"] for claim in workload["spec"].get("volumeClaimTemplates", [])]
        declared = {*claims, *(volume["name"] for volume in pod(workload)["volumes"])}
        mounts = {mount["mountPath"]: mount for mount in one["volumeMounts"]}
        assert {mount["name"] for mount in mounts.values()} <= declared, name
        words = one.get("args", [])
        for option in {"--out", "--state"} & set(words):
            mount = mounts[words[words.index(option) + 1]]
            assert mount["name"] in claims, f"{name}: it would be lost with the pod"
            assert not mount.get("readOnly"), name


@both
def test_a_monitor_starts_with_the_compiled_kernels_of_the_image_on_a_volume(folder: Path, tmp_path: Path) -> None:
    """Numba reads no cache that it cannot write to, and an empty volume in its place hides the image's."""
    monitor = workloads(folder)["monitor"]
    (first,) = pod(monitor)["initContainers"]
    (mount,) = first["volumeMounts"]
    assert {**mount, "mountPath": "/home/reactorwatch/.cache"} in container(monitor)["volumeMounts"]
    kernel = tmp_path / "home" / "numba" / "kernel.nbc"
    kernel.parent.mkdir(parents=True)
    kernel.write_bytes(b"code")
    (tmp_path / "volume").mkdir()
    outside = {"/home/reactorwatch/.cache/.": f"{tmp_path}/home/.", mount["mountPath"]: f"{tmp_path}/volume"}
    for _ in range(2):  # a pod may start it again
        subprocess.run([outside.get(word, word) for word in first["command"]], check=True)
    assert (tmp_path / "volume" / "numba" / "kernel.nbc").read_bytes() == b"code"
    assert first["image"] == container(monitor)["image"]
    assert "NUMBA_CACHE_DIR=/home/reactorwatch/.cache/" in (ROOT / "Dockerfile").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "folder"), [("router", "/etc/zenoh"), *((node, "/etc/reactorwatch") for node in NODES)]
)
def test_each_pod_sees_the_secret_of_its_own_role_read_only(name: str, folder: str) -> None:
    workload = workloads(SECURE)[name]
    (volume,) = [volume for volume in pod(workload)["volumes"] if "secret" in volume]
    assert volume["secret"] == {"secretName": name, "defaultMode": 0o440}
    (mount,) = [mount for mount in container(workload)["volumeMounts"] if mount["name"] == volume["name"]]
    assert mount == {"name": volume["name"], "mountPath": folder, "readOnly": True}
    words = container(workload)["args"]
    assert str(Path(words[words.index("--config") + 1]).parent) == folder
    assert not re.search("tcp/|--endpoint", json.dumps(workload)), "it would go by plain TCP"


def test_the_router_s_settings_are_found_where_it_works() -> None:
    """Zenoh reads files relative to the folder that it works in, and the settings name them without one."""
    router = container(workloads(SECURE)["router"])
    assert router["args"] == ["--config", f"{router['workingDir']}/router.json5"]


def test_the_commands_that_make_the_secrets_name_those_that_are_mounted() -> None:
    text = (SECURE / "kustomization.yaml").read_text(encoding="utf-8")
    made = re.findall(r"kubectl create secret generic (\S+) --from-file=SITE/(\S+)$", text, re.MULTILINE)
    assert made == [("router", "router"), ("monitor", "fleet/monitor"), ("recorder", "fleet/recorder")]


# --- lives --------------------------------------------------------------------------------------------------------


@both
def test_the_monitors_have_every_shard_once(folder: Path) -> None:
    monitor = workloads(folder)["monitor"]
    of_pods = [environment["POD_INDEX"] + "/" + environment["SHARDS"] for environment in environments(monitor)]
    count = monitor["spec"]["replicas"]
    assert [parse_shard(text) for text in of_pods] == [(number, count) for number in range(1, count + 1)]
    words = container(monitor)["args"]
    assert words[words.index("--shard") + 1] == "$(POD_INDEX)/$(SHARDS)"


@both
def test_no_router_restarts_no_node(folder: Path) -> None:
    """A node waits for its router; only what says that it is of use depends on it."""
    for name in NODES:
        workload = workloads(folder)[name]
        assert {key for key in container(workload) if key.endswith("Probe")} == {"readinessProbe"}, name
        assert container(workload)["readinessProbe"]["timeoutSeconds"] > 5, f"{name}: status --check itself waits 5 s"
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert container(workloads(folder)["router"])[probe]["tcpSocket"] == {"port": "zenoh"}


@both
def test_a_drain_takes_one_monitor_at_a_time_also_without_a_router(folder: Path) -> None:
    (budget,) = [item["spec"] for item in build(folder) if item["kind"] == "PodDisruptionBudget"]
    assert (budget["maxUnavailable"], budget["unhealthyPodEvictionPolicy"]) == (1, "AlwaysAllow")


@both
def test_there_are_never_two_routers_or_two_recorders(folder: Path) -> None:
    found = workloads(folder)
    assert [found[name]["spec"]["replicas"] for name in ("router", "recorder")] == [1, 1]
    assert found["router"]["spec"]["strategy"] == {"type": "Recreate"}
    assert found["recorder"]["kind"] == found["monitor"]["kind"] == "StatefulSet"
