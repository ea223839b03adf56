"""LPIPS: its networks, the search for weights, and their installation, from a server here instead of the real ones."""

from __future__ import annotations

import ast
import hashlib
import logging
import re
import socket
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.registry import REGISTRIES
from coliags_plugin.metrics import lpips
from coliags_plugin.metrics.lpips import (
    BACKBONE_FILES,
    DEFAULT_NETS,
    SOURCES,
    TAPS,
    LPIPSNetwork,
    Published,
    features,
    find_weights,
    install,
)
from tests.commands import refused, run
from tests.metrics.made import images, lay_out, make, random_backbone, random_heads

# --------------------------------------------------------------------------------------------------- the real weights


@pytest.fixture
def squeeze(shared_data, nowhere, monkeypatch):
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(shared_data / "lpips"))
    return partial(make, "lpips", net="squeeze")


def test_the_example_images_score_as_the_lpips_package_scores_them(squeeze, examples):
    """0.7110476 and 0.1479016: lpips 0.1.4 (net="squeeze") on the same weights and images, run once."""
    metric = squeeze(input_range="minus-one-one")
    assert metric(images(examples["p0"], examples["ref"])) == pytest.approx(0.7110476, abs=2e-6)
    assert metric(images(examples["p1"], examples["ref"])) == pytest.approx(0.1479016, abs=2e-6)


def test_unmapped_images_give_other_values_in_the_same_order_and_direction(squeeze, examples):
    blurred, warped, same = (squeeze()(images(examples[name], examples["ref"])) for name in ("p0", "p1", "ref"))
    assert 0 == same < warped < blurred == squeeze()(images(examples["ref"], examples["p0"]))
    mapped = squeeze(input_range="minus-one-one")(images(examples["p0"], examples["ref"]))
    assert abs(blurred - mapped) > 0.001


def test_ignored_pixels_do_not_change_lpips_and_are_left_out_of_its_mean(squeeze, examples):
    left = torch.ones(64, 64, dtype=torch.bool)
    left[:, 32:] = False
    truth, rendered = examples["ref"], torch.where(left[..., None], examples["p0"], examples["ref"])
    hidden, other = (
        torch.where(left[..., None], image, value) for image, value in ((rendered, torch.nan), (truth, 7.0))
    )
    masked = squeeze()(images(rendered, truth, left))
    assert squeeze()(images(hidden, other, left)) == masked
    assert masked > 1.2 * squeeze()(images(rendered, truth))  # only the left half differs


# ------------------------------------------------------------------------------------------------------ architectures


@pytest.mark.parametrize(
    ("net", "sizes"), [("vgg", [96, 48, 24, 12, 6]), ("alex", [23, 11, 5, 5, 5]), ("squeeze", [47, 23, 11, 5, 5, 5, 5])]
)
def test_every_tap_is_a_relu_of_the_right_width_and_size(net, sizes):
    x, taps = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(0)), []
    with torch.device("meta"):
        layers = features(net)
    layers.load_state_dict(random_backbone(net), assign=True)
    for index, layer in enumerate(layers):
        x = layer(x)
        if index in TAPS[net]:
            taps.append((x.shape[1], x.shape[2]))
            assert x.min() == 0
    assert taps == list(zip(TAPS[net].values(), sizes, strict=True))


def test_the_first_tap_against_numpy():
    """Standardise, convolve with stride 2, rectify, normalise, square, weigh, average: by hand."""
    state, heads = random_backbone("squeeze"), [head * 0 for head in random_heads("squeeze").values()]
    heads[0] = random_heads("squeeze")["lin0.model.1.weight"]
    network = LPIPSNetwork("squeeze", state, heads)
    generator = torch.Generator().manual_seed(2)
    a, b = torch.rand(1, 3, 33, 37, generator=generator), torch.rand(1, 3, 33, 37, generator=generator)

    def tap(image):
        x = (image[0].double().numpy() - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array(
            [0.458, 0.448, 0.450]
        )[:, None, None]
        patches = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2]
        y = np.maximum(np.einsum("chwij,ocij->ohw", patches, state["0.weight"].double().numpy()), 0)
        return y / (np.sqrt((y * y).sum(0)) + 1e-10)

    squared = (tap(a) - tap(b)) ** 2
    expected = (heads[0].double().numpy()[0] * squared).sum(0).mean()
    distance = network(a, b, torch.ones(33, 37, dtype=torch.bool))
    assert distance.item() == pytest.approx(expected, rel=1e-5)


def test_building_a_network_draws_no_random_numbers(pair):
    state = torch.random.get_rng_state()
    network = LPIPSNetwork("vgg", random_backbone("vgg"), list(random_heads("vgg").values()))
    assert torch.equal(torch.random.get_rng_state(), state)
    image, truth = (x.permute(2, 0, 1)[None] for x in (pair.rgb, pair.true_rgb))
    assert 0 < network(image, truth, pair.valid).item() < 100


# ------------------------------------------------------------------------------------------------- finding the weights


@pytest.mark.parametrize("heads", ["{}.pth", "v0.1/{}.pth"])
def test_a_named_folder_comes_before_the_environment_s(heads, nowhere, monkeypatch):
    lay_out(nowhere / "first", "alex", heads)
    lay_out(nowhere / "second", "alex", heads)
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere / "second"))
    assert {file.parents[heads.count("/")] for file in lpips.find_weights("alex")[1:]} == {nowhere / "second"}
    backbone, linear = lpips.find_weights("alex", nowhere / "first")
    assert backbone.parent == nowhere / "first"
    assert linear == nowhere / "first" / heads.format("alex")


def test_missing_weights_say_what_and_how_to_get_it(nowhere, pair, monkeypatch):
    with pytest.raises(UnavailableError, match=r"vgg16-397923af.pth.*v0.1/vgg.pth.*`coliags weights`") as caught:
        make("lpips", net="vgg")(pair)
    assert str(nowhere) not in str(caught.value), "results are to be the same on every machine"
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere))
    torch.save(random_heads("vgg"), nowhere / "vgg.pth")
    with pytest.raises(UnavailableError, match="backbone") as caught:
        make("lpips", net="vgg")(pair)
    assert "linear heads" not in str(caught.value)


#: Which of backbone and heads is damaged, and how.
DAMAGES = {
    "truncated": (0, lambda file: file.write_bytes(file.read_bytes()[:1000])),
    "other net": (0, lambda file: torch.save(random_backbone("alex"), file)),
    "not tensors": (0, lambda file: torch.save([1, 2], file)),
    "wrong heads": (1, lambda file: torch.save(random_heads("alex"), file)),
    "negative heads": (1, lambda file: torch.save({k: -v for k, v in random_heads("squeeze").items()}, file)),
}


@pytest.mark.parametrize(("part", "spoil"), DAMAGES.values(), ids=DAMAGES)
def test_weights_that_do_not_fit_name_the_file(part, spoil, nowhere, pair, monkeypatch):
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere))
    lay_out(nowhere, "squeeze")
    file = find_weights("squeeze")[part]
    spoil(file)
    with pytest.raises(UnavailableError, match=re.escape(str(file))):
        make("lpips", net="squeeze")(pair)


def test_too_small_images():
    with pytest.raises(UnavailableError, match="40x31"):
        make("lpips")(images(torch.zeros(31, 40, 3), torch.ones(31, 40, 3)))


def test_the_network_is_read_once(nowhere, pair, monkeypatch):
    lay_out(nowhere / "kept", "alex")
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere / "kept"))
    metric = make("lpips", net="alex")
    with torch.inference_mode():
        first = metric(pair)
    (nowhere / "kept" / "v0.1" / "alex.pth").write_bytes(b"no longer read")
    assert metric(pair) == first


# ------------------------------------------------------------------------------------------------------- installation

NETS = ("alex", "squeeze")
ALEX = (BACKBONE_FILES["alex"], "v0.1/alex.pth")
SQUEEZE = (BACKBONE_FILES["squeeze"], "v0.1/squeeze.pth")
EVERYTHING = sorted((*ALEX, *SQUEEZE))


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with random weights of two nets, as published."""
    folder = tmp_path_factory.mktemp("published")
    for net in NETS:
        lay_out(folder, net)
    return folder


@pytest.fixture
def cache(nowhere, monkeypatch):
    """torch's download cache, on a machine without weights and proxies."""
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return nowhere / "torch" / "hub" / "checkpoints"


@pytest.fixture
def server(made, cache, monkeypatch):
    """Files, whether responses end half way, and paths asked for, of the server that the table of sources names."""
    state = SimpleNamespace(files={}, cut=False, requests=[])

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *args):
            pass

        def do_GET(self):
            state.requests.append(self.path)
            data = state.files.get(self.path)
            if data is None:
                return self.send_error(503)
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data[: len(data) // 2] if state.cut else data)

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        state.url = f"http://127.0.0.1:{server.server_port}"
        for net, paths in zip(NETS, (ALEX, SQUEEZE), strict=True):
            state.files |= {f"/{path}": (made / path).read_bytes() for path in paths}
            pair = (Published(f"{state.url}/{path}", path, sha256(made / path)) for path in paths)
            monkeypatch.setitem(SOURCES, net, tuple(pair))
        yield state
        server.shutdown()


def direct(net, pair):
    """LPIPS of the weights themselves, past all files."""
    network = LPIPSNetwork(net, random_backbone(net), list(random_heads(net).values()))
    image, truth = (x.permute(2, 0, 1)[None] for x in (pair.rgb, pair.true_rgb))
    return network(image, truth, pair.valid).item()


# Downloading


@pytest.mark.parametrize("copied", [False, True])
def test_what_is_downloaded_or_copied_is_found_and_gives_the_same_values(server, cache, made, pair, copied):
    """Small files come first, and nothing is asked for where nothing is missing."""
    written = install(NETS, None, made if copied else None)
    assert sorted(path.relative_to(cache).as_posix() for path in written) == files(cache) == EVERYTHING
    assert server.requests[:2] == ([] if copied else ["/v0.1/alex.pth", "/v0.1/squeeze.pth"])
    for net, (backbone, heads) in zip(NETS, (ALEX, SQUEEZE), strict=True):
        assert find_weights(net) == (cache / backbone, cache / heads)
        assert make("lpips", net=net)(pair) == pytest.approx(direct(net, pair), rel=1e-6)
    assert install(NETS, None, made if copied else None) == []
    assert len(server.requests) == (0 if copied else 4)


def test_only_what_is_missing_is_fetched(server, cache, made, monkeypatch):
    other = cache.parent / "other"
    (other / "v0.1").mkdir(parents=True)
    (other / "v0.1" / "alex.pth").write_bytes((made / "v0.1" / "alex.pth").read_bytes())
    monkeypatch.setenv("COLIAGS_LPIPS_WEIGHTS", str(other))
    assert install(["alex"], None, None) == [cache / BACKBONE_FILES["alex"]]
    assert find_weights("alex") == (cache / BACKBONE_FILES["alex"], other / "v0.1" / "alex.pth")


def test_without_a_connection_all_that_is_missing_is_named(server, cache):
    del server.files["/v0.1/squeeze.pth"]
    with pytest.raises(InputError) as caught:
        install(NETS, None, None)
    advice = re.search(
        r"On a machine with a connection download (.*), and pass `from_folder=FOLDER`", str(caught.value)
    )
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


@pytest.mark.parametrize("name", ALEX)
def test_nothing_is_copied_if_one_file_is_another(server, cache, made, tmp_path, name):
    (tmp_path / "v0.1").mkdir()
    for each in ALEX:
        data = bytearray((made / each).read_bytes())
        data[len(data) // 2] ^= each == name
        (tmp_path / each).write_bytes(data)
    with pytest.raises(InputError) as caught:
        install(["alex"], None, tmp_path)
    text = (str(tmp_path / name), sha256(tmp_path / name), sha256(made / name))
    assert all(part in str(caught.value) for part in text)
    assert not cache.exists()


def test_a_folder_that_lacks_files_says_which(server, cache, made, tmp_path):
    (tmp_path / "alex.pth").write_bytes((made / "v0.1/alex.pth").read_bytes())
    with pytest.raises(InputError) as caught:
        install(NETS, None, tmp_path)
    for name in EVERYTHING:
        assert (f"{server.url}/{name}" in str(caught.value)) == (name != "v0.1/alex.pth")
    assert not cache.exists()


# What is there already


def test_damaged_weights_are_named_and_not_touched(server, cache, made):
    install(["alex"], None, made)
    file = cache / BACKBONE_FILES["alex"]
    before = file.read_bytes()[:1000]
    file.write_bytes(before)
    with pytest.raises(InputError) as caught:
        install(["alex"], None, None)
    assert str(file) in str(caught.value) and "Remove that file" in str(caught.value)
    assert file.read_bytes() == before


def test_weights_of_one_s_own_are_used_with_a_warning(server, cache, made, caplog):
    install(["squeeze"], None, made)
    file = cache / BACKBONE_FILES["squeeze"]
    torch.save({key: 2 * value for key, value in random_backbone("squeeze").items()}, file)
    with caplog.at_level(logging.WARNING, logger=lpips.__name__):
        assert install(["squeeze"], None, None) == []
    assert [f"{file} is not the published file: its SHA-256 is {sha256(file)}"] == caplog.messages


# The command


def test_a_newcomer_s_way(server, cache, capsys):
    """The check names the command, which installs; then both say that all is there, and where."""
    where = f"LPIPS squeeze: backbone {cache / SQUEEZE[0]}, linear heads {cache / SQUEEZE[1]}\n"

    def checked():
        assert run("check", "installation") == 0
        (line,) = [line for line in capsys.readouterr().out.splitlines() if "weights of LPIPS squeeze" in line]
        return line

    line = checked()
    assert line.startswith("-  ") and "run `coliags weights`" in line
    for text in (where, f"{where}Everything was there already.\n"):
        assert run("weights", "--net", "squeeze") == 0
        assert capsys.readouterr().out == text
    assert len(server.requests) == 2
    line = checked()
    assert line.startswith("ok ") and line.endswith(f"{cache / SQUEEZE[0]} and {cache / SQUEEZE[1]}")


def test_a_folder_of_one_s_own_gets_everything_and_the_command_says_what_to_set(
    server, cache, made, tmp_path, monkeypatch, capsys
):
    install(NETS, None, made)
    mine = tmp_path / "mine"
    argv = ("weights", "--net", "squeeze", "--from", made, "--folder", mine)
    assert run(*argv) == 0
    assert files(mine) == [*SQUEEZE]
    assert f"Set COLIAGS_LPIPS_WEIGHTS={mine} " in capsys.readouterr().out
    monkeypatch.setenv("COLIAGS_LPIPS_WEIGHTS", str(mine))
    assert run(*argv) == 0
    assert "Set COLIAGS" not in capsys.readouterr().out
    assert find_weights("squeeze") == (mine / SQUEEZE[0], mine / SQUEEZE[1])
    assert not server.requests


@pytest.mark.parametrize(
    ("choice", "nets"),
    [([], ["vgg", "squeeze"]), (["--net", "alex"], ["alex"]), (["--net", "all"], ["vgg", "alex", "squeeze"])],
)
def test_offline_all_files_of_the_nets_are_named(cache, monkeypatch, capsys, choice, nets):
    def unknown(*args, **options):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    message = refused(capsys, "weights", *choice)
    assert "cannot download https://raw.githubusercontent.com" in message and "--from FOLDER" in message
    for net, pair in SOURCES.items():
        assert all((published.url in message) == (net in nets) for published in pair)
    assert files(cache) == []


def test_bad_input(capsys, cache, tmp_path):
    assert "is not a folder" in refused(capsys, "weights", "--from", tmp_path / "nothing")
    (tmp_path / "file").write_text("x")
    assert "cannot write" in refused(capsys, "weights", "--folder", tmp_path / "file")
    assert run("weights", "--net", "resnet") == 2


# The table


def test_default_nets_are_those_of_the_protocols():
    protocols = (REGISTRIES["protocols"].get(name) for name in REGISTRIES["protocols"])
    metrics = [metric for protocol in protocols for metric in protocol.metrics.values()]
    assert {options["net"] for name, options in metrics if name == "lpips"} == set(DEFAULT_NETS)


def test_checksums_of_backbones_are_those_in_their_names():
    for net in BACKBONE_FILES:
        backbone, heads = SOURCES[net]
        assert re.fullmatch(rf"https://download\.pytorch\.org/models/[\w-]+-{backbone.sha256}\.pth", backbone.url)
        assert backbone.path == backbone.url.rpartition("/")[2] == BACKBONE_FILES[net]
        assert re.fullmatch("[0-9a-f]{8}", backbone.sha256) and re.fullmatch("[0-9a-f]{64}", heads.sha256)


# The real files


def test_the_published_heads_have_the_checksums_of_the_table(shared_data):
    for _, heads in SOURCES.values():
        assert sha256(shared_data / "lpips" / heads.path) == heads.sha256


# The package


@pytest.mark.thorough
def test_nothing_else_in_the_package_reaches_for_the_network():
    package = Path(lpips.__file__).parents[1]
    users = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            imported += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            roots = {name.partition(".")[0] for name in imported if name != "urllib.parse"}
            if roots & {"urllib", "http", "socket", "requests", "pooch", "ftplib"}:
                users.add(path.relative_to(package).as_posix())
    # The executor only asks whether the cluster that the user named answers, the viewer whether its own port is free.
    assert users == {"metrics/lpips.py", "engine/ray_executor.py", "export/viewer/live.py"}
