"""The deployment files agree with the code: names of metrics, settings, commands, images and versions.

No container engine and no cluster take part; what is checked is everything that can drift without one.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.core import TyperGroup
from typer.main import get_command

from services.api.server import check_exposure
from services.cli.main import app
from services.domain.errors import InvalidRequest
from services.observability.metrics import Metrics
from services.settings import Settings
from services.store.sql import SqlStore

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text()


def exported_series() -> set[str]:
    """Every sample name that a scrape can show."""
    names = set()
    for family in Metrics().registry.collect():
        suffixes = {"counter": ["_total"], "histogram": ["_bucket", "_sum", "_count"]}.get(family.type, [""])
        names |= {family.name + suffix for suffix in suffixes}
    return names


def dashboard() -> Any:
    return json.loads((DEPLOY / "grafana/dashboards/vipe.json").read_text())


def alert_rules() -> Iterator[dict[str, Any]]:
    for group in yaml.safe_load((DEPLOY / "prometheus/alerts.yaml").read_text())["groups"]:
        yield from group["rules"]


def expressions() -> list[str]:
    panels = [target["expr"] for panel in dashboard()["panels"] for target in panel.get("targets", [])]
    return panels + [rule["expr"] for rule in alert_rules()]


def manifests() -> list[dict[str, Any]]:
    files = [path for path in sorted((DEPLOY / "kuberay").glob("*.yaml")) if path.name != "kustomization.yaml"]
    return [document for path in files for document in yaml.safe_load_all(path.read_text())]


def compose() -> Any:
    return yaml.safe_load((DEPLOY / "compose/compose.yaml").read_text())


def test_dashboard_and_alerts_use_only_exported_metrics() -> None:
    exported = exported_series()
    used = {name for expr in expressions() for name in re.findall(r"\bvipe_[a-z_]+", expr)}
    assert len(used) > 10
    assert used <= exported, f"not exported by the service: {sorted(used - exported)}"


def test_alerts_and_totals_hold_where_series_are_missing_or_start_again() -> None:
    rules = {rule["alert"]: rule["expr"] for rule in alert_rules()}
    stalled = rules["VipeNoProgress"]
    assert stalled.count("or vector(0)") == stalled.count("== 0") == 2, (
        "no agent, no series: that is no progress either"
    )
    assert "vipe_frames_in_progress" in stalled, "a long shard settles no video for hours"
    assert "vipe_shards" not in stalled, "a paused job leaves shards pending for as long as it likes"
    counters = {name for name in exported_series() if name.startswith("vipe_") and name.endswith("_total")}
    for expr in expressions():
        for name in counters & set(re.findall(r"\bvipe_[a-z_]+", expr)):
            bare = re.findall(rf"(\w+)\({name}(?:{{[^}}]*}})?(\[)?", expr)
            assert bare, expr
            assert all(call in ("rate", "increase") and window for call, window in bare), expr


def test_the_dashboard_shows_every_metric() -> None:
    shown = {name for expr in expressions() for name in re.findall(r"\bvipe_[a-z_]+", expr)}
    named = {name.removesuffix("_bucket").removesuffix("_sum") for name in shown}
    families = {family.name for family in Metrics().registry.collect() if family.name.startswith("vipe_")}
    missing = {name for name in families if name not in named and f"{name}_total" not in named}
    assert missing == {"vipe_build_info"}


def test_dashboard_labels_exist() -> None:
    labels = {label for family in Metrics().registry.collect() for label in family_labels(family.name)}
    for expr in expressions():
        for group in re.findall(r"by \(([^)]*)\)", expr):
            assert {label.strip() for label in group.split(",")} <= labels | {"le"}, expr


def family_labels(name: str) -> tuple[str, ...]:
    for metric in vars(Metrics()).values():
        if getattr(metric, "_name", None) == name:
            return tuple(metric._labelnames)
    return ()


def test_dashboard_panels_are_provisioned_and_do_not_overlap() -> None:
    board = dashboard()
    assert board["uid"] == "vipe"
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"])
    cells = [
        (x, y)
        for panel in board["panels"]
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(cells) == len(set(cells))
    provider = yaml.safe_load((DEPLOY / "grafana/provisioning/dashboards/vipe.yaml").read_text())["providers"][0]
    assert f"../grafana/dashboards:{provider['options']['path']}:ro" in compose()["services"]["grafana"]["volumes"]


def container_environments() -> Iterator[tuple[str, str]]:
    for name, service in compose()["services"].items():
        for variable in service.get("environment", {}):
            yield f"compose {name}", variable
    for document in manifests():
        if document["kind"] == "ConfigMap":
            for variable in document["data"]:
                yield "settings.yaml", variable
        for container in containers(document):
            for variable in container.get("env", []):
                yield document["metadata"]["name"], variable["name"]
    for variable in re.findall(r"\b(VIPE_[A-Z_0-9]+)=", DOCKERFILE):
        yield "Dockerfile", variable


def containers(document: Any) -> Iterator[dict[str, Any]]:
    if isinstance(document, dict):
        yield from document.get("containers", [])
        for value in document.values():
            yield from containers(value)
    elif isinstance(document, list):
        for value in document:
            yield from containers(value)


def test_every_setting_in_a_container_is_one_that_the_service_reads() -> None:
    known = {f"VIPE_{field.upper()}" for field in Settings.model_fields}
    used = [(where, variable) for where, variable in container_environments() if variable.startswith("VIPE_")]
    assert len(used) > 8
    for where, variable in used:
        assert variable in known, f"{where} sets {variable}, which nothing reads"


def shell_commands() -> list[list[str]]:
    images = [json.loads(line) for line in re.findall(r"^CMD (\[.*\])$", DOCKERFILE, re.M)]
    pods = [
        shlex.split(container["command"][-1].split("exec ")[-1])
        for document in manifests()
        for container in containers(document)
        if container.get("command")
    ]
    return [command for command in images + pods if command[0] == "vipectl"]


def test_container_commands_exist_in_the_program() -> None:
    program = get_command(app)
    commands = shell_commands()
    assert len(commands) == 4
    for _, name, *arguments in commands:
        assert isinstance(program, TyperGroup)
        subcommand = program.commands[name]
        with subcommand.make_context(name, arguments):
            pass  # click parsed every option


def test_every_api_that_listens_beyond_its_container_has_a_key(tmp_path: Path) -> None:
    assert ["vipectl", "api", "--host", "0.0.0.0", "--port", "8080"] in shell_commands()
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    with pytest.raises(InvalidRequest):
        check_exposure(Settings(host="0.0.0.0"), store)
    store.close()
    assert "VIPE_API_KEY" in compose()["services"]["api"]["environment"]
    assert "VIPE_API_KEY" not in compose()["services"]["agent"]["environment"]
    (api,) = (d for d in manifests() if d["kind"] == "Deployment" and d["metadata"]["name"] == "vipe-api")
    assert "VIPE_API_KEY" in {variable["name"] for container in containers(api) for variable in container["env"]}


def test_compose_builds_targets_that_the_dockerfile_has() -> None:
    stages = set(re.findall(r"^FROM \S+ AS (\S+)$", DOCKERFILE, re.M))
    gpu = yaml.safe_load((DEPLOY / "compose/gpu.yaml").read_text())
    builds = [
        service["build"] for file in (compose(), gpu) for service in file["services"].values() if "build" in service
    ]
    assert len(builds) == 4
    for build in builds:
        assert build["target"] in stages
    for name, service in compose()["services"].items():
        for dependency in service.get("depends_on", {}):
            assert dependency in compose()["services"], f"{name} depends on {dependency}"


def test_dockerfile_copies_what_the_context_lets_through() -> None:
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    for sources in re.findall(r"^COPY (.+) \S+$", DOCKERFILE, re.M):
        for source in sources.split():
            assert source.strip("./") in allowed
            assert (ROOT / source).exists()


def test_prometheus_scrapes_ports_that_the_images_open() -> None:
    scrapes = yaml.safe_load((DEPLOY / "prometheus/prometheus.yaml").read_text())["scrape_configs"]
    targets = {target for scrape in scrapes for static in scrape["static_configs"] for target in static["targets"]}
    for target in targets:
        service, port = target.split(":")
        stage = compose()["services"][service]["build"]["target"]
        body = DOCKERFILE.split(f" AS {stage}\n")[1].split("FROM ")[0]
        assert f"EXPOSE {port}" in body


def test_cluster_runs_the_ray_of_the_lock() -> None:
    locked = re.search(r"^ray==(\S+)$", (ROOT / "requirements.lock").read_text(), re.M)
    cluster = next(document for document in manifests() if document["kind"] == "RayCluster")
    assert locked is not None
    assert cluster["spec"]["rayVersion"] == locked[1]
    assert cluster["spec"]["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    agent = next(document for document in manifests() if document["metadata"]["name"] == "vipe-agent")
    assert (
        f"{cluster['metadata']['name']}-head-svc:6379"
        in agent["spec"]["template"]["spec"]["containers"][0]["command"][-1]
    )


def ray_pods() -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """(labels, container) of everything that is a node of the Ray cluster: head, workers, agent."""
    cluster = next(document for document in manifests() if document["kind"] == "RayCluster")["spec"]
    agent = next(document for document in manifests() if document["metadata"]["name"] == "vipe-agent")
    templates = [cluster["headGroupSpec"]["template"], *(group["template"] for group in cluster["workerGroupSpecs"])]
    templates.append(agent["spec"]["template"])
    return [(template["metadata"]["labels"], template["spec"]["containers"][0]) for template in templates]


def test_ray_serves_only_holders_of_the_token() -> None:
    assert len(ray_pods()) == 3
    for _, container in ray_pods():
        variables = {variable["name"]: variable for variable in container["env"]}
        assert variables["RAY_AUTH_MODE"]["value"] == "token"
        assert variables["RAY_AUTH_TOKEN"]["valueFrom"]["secretKeyRef"] == {"name": "vipe", "key": "ray-auth-token"}
    cluster = next(document for document in manifests() if document["kind"] == "RayCluster")["spec"]
    assert cluster["headGroupSpec"]["rayStartParams"]["dashboard-host"] == "127.0.0.1"
    needed = (DEPLOY / "kuberay/kustomization.yaml").read_text()
    for reference in re.findall(r"name: vipe, key: ([a-z-]+)", "".join(p.read_text() for p in kuberay_files())):
        assert reference in needed, f"the Secret's key {reference} is not asked for"
    bound = re.search(r'"ray>=(\d+)\.(\d+)"', (ROOT / "pyproject.toml").read_text())
    assert bound is not None
    assert (int(bound[1]), int(bound[2])) >= (2, 52), "an older Ray ignores the token"


def kuberay_files() -> list[Path]:
    return sorted((DEPLOY / "kuberay").glob("*.yaml"))


def test_slots_are_as_many_as_the_gpus_of_the_cluster() -> None:
    settings = next(document for document in manifests() if document["kind"] == "ConfigMap")["data"]
    groups = next(document for document in manifests() if document["kind"] == "RayCluster")["spec"]["workerGroupSpecs"]
    gpus = sum(
        group["replicas"] * int(group["template"]["spec"]["containers"][0]["resources"]["limits"]["nvidia.com/gpu"])
        for group in groups
    )
    assert int(settings["VIPE_NUM_SLOTS"]) == gpus * int(settings["VIPE_SLOTS_PER_GPU"])


def test_probes_ask_what_minimal_ray_answers() -> None:
    """Without probes of ours the operator adds its own, which need a dashboard and wget."""
    cluster = next(document for document in manifests() if document["kind"] == "RayCluster")["spec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        (container,) = group["template"]["spec"]["containers"]
        ports = {port["name"]: port["containerPort"] for port in container["ports"]}
        assert str(ports.get("raylet", 6380)) == group["rayStartParams"]["node-manager-port"]
        for probe in ("readinessProbe", "livenessProbe"):
            assert container[probe]["tcpSocket"]["port"] in ports


def test_the_network_is_closed_but_for_the_api_and_metrics() -> None:
    policies = {d["metadata"]["name"]: d["spec"] for d in manifests() if d["kind"] == "NetworkPolicy"}
    assert policies.pop("deny-by-default") == {"podSelector": {}, "policyTypes": ["Ingress"]}
    ray = policies["ray"]
    (term,) = ray["podSelector"]["matchExpressions"]
    assert {labels["app"] for labels, _ in ray_pods()} == set(term["values"])
    assert ray["ingress"] == [{"from": [{"podSelector": ray["podSelector"]}]}], "from each other, and from nobody else"
    opened = {p["podSelector"]["matchLabels"]["app"]: p for name, p in policies.items() if name != "ray"}
    for deployment in (d for d in manifests() if d["kind"] == "Deployment"):
        template = deployment["spec"]["template"]
        policy = opened.pop(template["metadata"]["labels"]["app"])
        ports = {port["name"] for port in template["spec"]["containers"][0]["ports"]}
        assert {port["port"] for rule in policy["ingress"] for port in rule["ports"]} == ports
    assert not opened


def test_pods_run_unprivileged() -> None:
    for document in manifests():
        for template in pod_specs(document):
            assert template["securityContext"]["runAsNonRoot"] is True, document["metadata"]["name"]


def pod_specs(document: Any) -> Iterator[dict[str, Any]]:
    if isinstance(document, dict):
        if "containers" in document:
            yield document
        for value in document.values():
            yield from pod_specs(value)
    elif isinstance(document, list):
        for value in document:
            yield from pod_specs(value)


def test_kustomize_renders_with_tagged_images() -> None:
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        pytest.skip("kubectl is not installed: the kustomization was parsed, not rendered")
    rendered = subprocess.run(
        [kubectl, "kustomize", str(DEPLOY / "kuberay")], check=True, capture_output=True, text=True
    ).stdout
    documents = list(yaml.safe_load_all(rendered))
    assert {document["kind"] for document in documents} == {
        "Namespace", "ConfigMap", "Deployment", "Service", "RayCluster", "NetworkPolicy",
    }  # fmt: skip
    images = {container["image"] for document in documents for container in containers(document)}
    assert images == {"vipe-api:0.1.0", "vipe-worker:0.1.0-gpu"}
