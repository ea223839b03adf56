"""LPIPS weights are installed where LPIPS finds them, or not at all."""

from __future__ import annotations

import ast
import hashlib
import logging
import re
from pathlib import Path

import pytest
import torch

from coliags_plugin.config.registry import REGISTRIES
from coliags_plugin.core.errors import InputError
from coliags_plugin.metrics import lpips_install
from coliags_plugin.metrics.lpips_install import SOURCES, Published, install
from coliags_plugin.metrics.lpips_network import LPIPSNetwork
from coliags_plugin.metrics.lpips_weights import BACKBONE_FILES, DEFAULT_NETS, find_weights, load_network, weights_in
from tests.file_server import file_server
from tests.metrics.made import images, make
from tests.metrics.weight_files import lay_out, random_backbone, random_heads

NETS = ("alex", "squeeze")


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with random weights of two nets, as published."""
    folder = tmp_path_factory.mktemp("published")
    for net in NETS:
        lay_out(folder, net)
    return folder


@pytest.fixture
def server(made, nowhere, monkeypatch):
    """A server that has them, which the table of sources names."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with file_server() as server:
        for net in NETS:
            pair = []
            for file, path in zip(weights_in(net, [made]), (BACKBONE_FILES[net][0], f"v0.1/{net}.pth"), strict=True):
                server.files[f"/{path}"] = file.read_bytes()
                pair.append(Published(f"{server.url}/{path}", {sha256(file): path}))
            monkeypatch.setitem(SOURCES, net, tuple(pair))
        yield server


@pytest.fixture
def cache(nowhere):
    """torch's download cache."""
    return nowhere / "torch" / "hub" / "checkpoints"


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


EVERYTHING = ["alexnet-owt-7be5be79.pth", "squeezenet1_1-b8a52dc0.pth", "v0.1/alex.pth", "v0.1/squeeze.pth"]


def direct(net, pair):
    """LPIPS of the weights themselves, past all files."""
    network = LPIPSNetwork(net, random_backbone(net), list(random_heads(net).values()))
    image, truth = (x.permute(2, 0, 1)[None] for x in (pair.rgb, pair.true_rgb))
    return network(image, truth, pair.valid).item()


# Downloading


@pytest.mark.parametrize("copied", [False, True])
def test_what_is_downloaded_or_copied_is_found_and_gives_the_same_values(server, cache, made, pair, copied):
    written = install(NETS, None, made if copied else None)
    assert sorted(path.relative_to(cache).as_posix() for path in written) == files(cache) == EVERYTHING
    assert bool(server.requests) != copied
    for net in NETS:
        assert find_weights(net) == (cache / BACKBONE_FILES[net][0], cache / "v0.1" / f"{net}.pth")
        assert make("lpips", net=net)(pair) == pytest.approx(direct(net, pair), rel=1e-6)
    assert install(NETS, None, made if copied else None) == []


def test_small_files_come_first_and_nothing_is_asked_for_where_nothing_is_missing(server):
    install(NETS, None, None)
    assert server.requests[:2] == ["/v0.1/alex.pth", "/v0.1/squeeze.pth"]
    server.requests.clear()
    install(NETS, None, None)
    assert server.requests == []


def test_only_what_is_missing_is_fetched(server, cache, made, monkeypatch):
    other = cache.parent / "other"
    (other / "v0.1").mkdir(parents=True)
    (other / "v0.1" / "alex.pth").write_bytes((made / "v0.1" / "alex.pth").read_bytes())
    monkeypatch.setenv("COLIAGS_LPIPS_WEIGHTS", str(other))
    assert install(["alex"], None, None) == [cache / BACKBONE_FILES["alex"][0]]
    assert find_weights("alex") == (cache / BACKBONE_FILES["alex"][0], other / "v0.1" / "alex.pth")


def test_a_folder_of_one_s_own_gets_everything(server, cache, tmp_path):
    install(NETS, None, None)
    folder = tmp_path / "mine"
    assert len(install(NETS, folder, None)) == 4
    assert files(folder) == EVERYTHING
    assert find_weights("alex", folder)[0].parent == folder


def test_without_a_connection_all_that_is_missing_is_named(server, cache):
    server.statuses = {"/v0.1/squeeze.pth": 503}
    with pytest.raises(InputError) as caught:
        install(NETS, None, None)
    advice = re.search(r"On a machine with a connection download (.*), and pass --from FOLDER", str(caught.value))
    left = [path for path in EVERYTHING if path != "v0.1/alex.pth"]  # which has come
    assert sorted(advice[1].split(", ")) == sorted(f"{server.url}/{path}" for path in left)
    assert files(cache) == ["v0.1/alex.pth"]


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda server: setattr(server, "cut", True), "cannot download"),
        (lambda server: server.files.update(dict.fromkeys(server.files, b"Log in first")), "has the SHA-256"),
    ],
    ids=["broken", "another"],
)
def test_what_does_not_arrive_whole_is_not_installed(server, cache, spoil, message):
    spoil(server)
    with pytest.raises(InputError, match=message):
        install(["alex"], None, None)
    assert files(cache) == []


# Copying


def test_heads_beside_the_backbone_are_taken_too(server, cache, made, tmp_path):
    for name in (BACKBONE_FILES["alex"][0], "v0.1/alex.pth"):
        (tmp_path / name.rpartition("/")[2]).write_bytes((made / name).read_bytes())
    install(["alex"], None, tmp_path)
    assert files(cache) == ["alexnet-owt-7be5be79.pth", "v0.1/alex.pth"]


def test_a_copy_under_another_name_gets_that_of_its_checksum(server, cache, made, tmp_path, monkeypatch):
    """Features alone must not pass for torchvision's file, wherever they lie."""
    lay_out(tmp_path, "squeeze")
    file = tmp_path / BACKBONE_FILES["squeeze"][0]
    torch.save(random_backbone("squeeze"), file)
    backbone, heads = SOURCES["squeeze"]
    known = {**backbone.known, sha256(file): "squeeze.backbone.pth"}
    monkeypatch.setitem(
        SOURCES,
        "squeeze",
        (Published(backbone.url, known), Published(heads.url, {sha256(tmp_path / "v0.1/squeeze.pth"): heads.path})),
    )
    install(["squeeze"], None, tmp_path)
    assert files(cache) == ["squeeze.backbone.pth", "v0.1/squeeze.pth"]
    assert find_weights("squeeze")[0] == cache / "squeeze.backbone.pth"


@pytest.mark.parametrize("which", ["backbone", "heads"])
def test_nothing_is_copied_if_one_file_is_another(server, cache, made, tmp_path, which):
    lay_out(tmp_path, "alex")
    name = BACKBONE_FILES["alex"][0] if which == "backbone" else "v0.1/alex.pth"
    spoiled = bytearray((made / name).read_bytes())
    spoiled[len(spoiled) // 2] ^= 1
    (tmp_path / name).write_bytes(spoiled)
    for other in {BACKBONE_FILES["alex"][0], "v0.1/alex.pth"} - {name}:
        (tmp_path / other).write_bytes((made / other).read_bytes())
    with pytest.raises(InputError) as caught:
        install(["alex"], None, tmp_path)
    text = str(caught.value)
    assert str(tmp_path / name) in text and hashlib.sha256(spoiled).hexdigest() in text and sha256(made / name) in text
    assert not cache.exists()


def test_a_folder_that_lacks_files_says_which(server, cache, made, tmp_path):
    (tmp_path / "alex.pth").write_bytes((made / "v0.1/alex.pth").read_bytes())
    with pytest.raises(InputError) as caught:
        install(NETS, None, tmp_path)
    for name in ("alexnet-owt-7be5be79.pth", "v0.1/squeeze.pth", "squeezenet1_1-b8a52dc0.pth"):
        assert f"{server.url}/{name}" in str(caught.value)
    assert "v0.1/alex.pth" not in str(caught.value)
    assert not cache.exists()
    with pytest.raises(InputError, match="is not a folder"):
        install(NETS, None, tmp_path / "nothing")


# What is there already


@pytest.mark.parametrize("damage", ["half", "other"])
def test_damaged_weights_are_named_and_not_touched(server, cache, made, damage):
    install(["alex"], None, made)
    file = cache / BACKBONE_FILES["alex"][0]
    if damage == "half":
        file.write_bytes(file.read_bytes()[:1000])
    else:
        torch.save(random_backbone("squeeze"), file)
    before = file.read_bytes()
    with pytest.raises(InputError) as caught:
        install(["alex"], None, None)
    assert str(file) in str(caught.value) and "Remove that file" in str(caught.value)
    assert file.read_bytes() == before


def test_weights_of_one_s_own_are_used_with_a_warning(server, cache, made, caplog):
    install(["squeeze"], None, made)
    file = cache / BACKBONE_FILES["squeeze"][0]
    torch.save({key: 2 * value for key, value in random_backbone("squeeze").items()}, file)
    with caplog.at_level(logging.WARNING, logger=lpips_install.__name__):
        assert install(["squeeze"], None, None) == []
    assert [f"{file} is not the published file: its SHA-256 is {sha256(file)}"] == caplog.messages


# The table


def test_default_nets_are_those_of_the_protocols():
    protocols = (REGISTRIES["protocols"].get(name) for name in REGISTRIES["protocols"])
    metrics = [metric for protocol in protocols for metric in protocol.metrics.values()]
    assert {options["net"] for name, options in metrics if name == "lpips"} == set(DEFAULT_NETS)


def first(published):
    """Checksum of what the URL gives, or its first digits."""
    return next(iter(published.known))


def test_checksums_of_backbones_are_those_in_their_names():
    for net in BACKBONE_FILES:
        backbone, heads = SOURCES[net]
        assert re.fullmatch(rf"https://download\.pytorch\.org/models/[\w-]+-{first(backbone)}\.pth", backbone.url)
        assert backbone.path == backbone.url.rpartition("/")[2] == BACKBONE_FILES[net][0]
        assert re.fullmatch("[0-9a-f]{8}", first(backbone)) and re.fullmatch("[0-9a-f]{64}", first(heads))
        assert heads.url.endswith(f"/richzhang/PerceptualSimilarity/master/lpips/weights/{heads.path}")
    assert set(SOURCES["alex"][0].known) == {"7be5be79", "4df8aa71"}


# The real files


def test_the_published_heads_have_the_checksums_of_the_table(shared_data):
    for _, heads in SOURCES.values():
        assert sha256(shared_data / "lpips" / heads.path) == first(heads)


def test_the_real_squeezenet_is_installed_and_scores_as_where_it_was(shared_data, nowhere, cache, examples):
    written = install(["squeeze"], None, shared_data / "lpips")
    assert sorted(written) == sorted(cache / name for name in files(cache)) == sorted(find_weights("squeeze"))
    comparison = images(examples["p0"], examples["ref"])
    value = make("lpips", net="squeeze", input_range="minus-one-one")(comparison)
    network = load_network("squeeze", *weights_in("squeeze", [shared_data / "lpips"]))
    first, second = (2 * x.permute(2, 0, 1)[None] - 1 for x in (examples["p0"], examples["ref"]))
    assert value == network(first, second, comparison.valid).item()


# The package


@pytest.mark.thorough
def test_nothing_else_in_the_package_reaches_for_the_network():
    package = Path(lpips_install.__file__).parents[1]
    users = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            imported += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            roots = {name.partition(".")[0] for name in imported if name != "urllib.parse"}
            if roots & {"urllib", "http", "socket", "requests", "pooch", "ftplib"}:
                users.add(path.relative_to(package).as_posix())
    # The executor only asks whether the cluster that the user named answers, the viewer whether its own port is free.
    assert users == {"metrics/lpips_install.py", "execution/ray_executor.py", "export/viewer/serving.py"}
