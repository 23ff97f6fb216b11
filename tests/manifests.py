"""The Kubernetes manifests, as `kubectl kustomize` resolves them: resources and strategic-merge patches."""

from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
PLAIN = ROOT / "deploy" / "kubernetes"
SECURE = PLAIN / "secure"

Manifest = dict[str, Any]

MERGED_BY = {
    **dict.fromkeys(("containers", "initContainers", "env", "volumes"), "name"),
    "volumeMounts": "mountPath",
}
"""Lists that a patch is merged into, with the key that identifies an item; it replaces all others."""


def build(folder: Path) -> list[Manifest]:
    """All objects of a kustomization."""
    settings = yaml.safe_load((folder / "kustomization.yaml").read_text(encoding="utf-8"))
    assert settings.keys() <= {"apiVersion", "kind", "resources", "patches"}, "this does nothing else"
    objects: list[Manifest] = []
    for name in settings["resources"]:
        path = folder / name
        objects += build(path) if path.is_dir() else yaml.safe_load_all(path.read_text(encoding="utf-8"))
    for entry in settings.get("patches", []):
        patch = yaml.safe_load((folder / entry["path"]).read_text(encoding="utf-8"))
        (patched,) = [item for item in objects if identity(item) == identity(patch)]
        objects[objects.index(patched)] = merge(patched, patch)
    return objects


def identity(item: Manifest) -> tuple[str, str]:
    """Kind and name of an object."""
    return item["kind"], item["metadata"]["name"]


def merge(old: Any, new: Any, name: str = "") -> Any:
    """A value with a patch; `name` is its key."""
    if isinstance(old, dict) and isinstance(new, dict):
        return {**old, **{key: merge(old.get(key), value, key) for key, value in new.items()}}
    if isinstance(old, list) and name in MERGED_BY:
        by = MERGED_BY[name]
        items = {item[by]: item for item in old}
        return list({**items, **{item[by]: merge(items.get(item[by]), item) for item in new}}.values())
    return new


def workloads(folder: Path) -> dict[str, Manifest]:
    """Deployments and StatefulSets of a kustomization, by name."""
    return {item["metadata"]["name"]: item for item in build(folder) if item["kind"] in ("Deployment", "StatefulSet")}


def pod(workload: Manifest) -> Manifest:
    """Specification of a workload's pods."""
    found: Manifest = workload["spec"]["template"]["spec"]
    return found


def container(workload: Manifest) -> Manifest:
    """The one container of a workload's pods, beside those that run before it."""
    (found,) = pod(workload)["containers"]
    return dict(found)


def environments(workload: Manifest) -> list[dict[str, str]]:
    """Environment of the container in each pod of a StatefulSet."""
    first = workload["spec"].get("ordinals", {}).get("start", 0)
    index = {"fieldRef": {"fieldPath": "metadata.labels['apps.kubernetes.io/pod-index']"}}
    found = []
    for ordinal in range(first, first + workload["spec"]["replicas"]):
        declared = container(workload).get("env", [])
        assert all("value" in item or item["valueFrom"] == index for item in declared)
        found.append({item["name"]: item.get("value", str(ordinal)) for item in declared})
    return found
