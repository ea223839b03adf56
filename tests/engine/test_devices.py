"""Names of devices, and which device kernels are launched on."""

import pytest
import torch

from coliags_plugin.comparison.compare import make_executor
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.devices import choose_device, find_device
from coliags_plugin.engine.tasks import ExecutionOptions

CPU = torch.device("cpu")


@pytest.fixture
def cards(monkeypatch):
    """Says how many CUDA devices there are; the list of those that were made current."""
    current = []
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"card {index}")

    def there_are(count):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        return current

    return there_are


def test_names_of_devices(cards):
    current = cards(2)
    named = {name: str(find_device(name)) for name in ("auto", "cpu", "cuda", "cuda:0", "cuda:1")}
    assert named == {"auto": "cuda:0", "cpu": "cpu", "cuda": "cuda:0", "cuda:0": "cuda:0", "cuda:1": "cuda:1"}
    assert current == []
    assert choose_device("cuda:1") == torch.device("cuda", 1) and choose_device("cpu") == CPU
    assert current == [torch.device("cuda", 1)]


def test_a_device_that_is_not_there(cards):
    cards(2)
    for name in ("gpu", "cuda:", "cuda:-1", "cuda:x", "cuda1", "mps", "CUDA", ""):
        with pytest.raises(InputError, match="auto, cpu, cuda or cuda:N"):
            find_device(name)
    with pytest.raises(InputError, match=r"cuda:1` with `executor=ray.*Ray gives each run its GPU"):
        make_executor(ExecutionOptions(device="cuda:1", executor="ray"))
    with pytest.raises(InputError, match=r"cuda:2 .*torch finds cuda:0 \(card 0\), cuda:1 \(card 1\)\. Expected one"):
        find_device("cuda:2")
    cards(0)
    assert find_device("auto") == find_device("cpu") == CPU
    for name in ("cuda", "cuda:0", "cuda:1"):
        with pytest.raises(InputError, match="torch finds none"):
            find_device(name)


@pytest.mark.parametrize(
    ("visible", "device", "gpus"),
    [
        (None, "auto", ("0", "1", "2")),
        (None, "cpu", ()),
        (None, "cuda:0", ("0",)),
        (None, "cuda:2", ("2",)),
        ("4,7,GPU-b", "cuda", ("4", "7", "GPU-b")),
        ("4,7,GPU-b", "cuda:1", ("7",)),
        ("4,7,GPU-b,99", "auto", ("4", "7", "GPU-b")),  # CUDA stops at the first that is not there
    ],
)
def test_a_comparison_uses_every_gpu_or_the_named_one(cards, monkeypatch, visible, device, gpus):
    cards(3)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    executor = make_executor(ExecutionOptions(device=device))
    assert executor._gpus == gpus
    if gpus:
        assert executor.slots == len(gpus)
