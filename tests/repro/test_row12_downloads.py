"""What is fetched is what was meant, or nothing of it stays."""

import contextlib
import http.server
import io
import threading
import zipfile
from dataclasses import replace

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.engines.cuda.compile import cache_folder
from etsplat.io import datasets
from etsplat.metrics import image


@pytest.fixture
def server():
    """Of this machine, in place of the real ones; it has the content of `content` at every address."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Length", str(len(self.server.content)))
            self.end_headers()
            self.wfile.write(self.server.content)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        running.url = f"http://127.0.0.1:{running.server_port}/file"
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield running
        running.shutdown()


def archive(*names):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name in names:
            file.writestr(name, "not what was meant\n")
    return buffer.getvalue()


@pytest.mark.parametrize("names", [["meshes-master/objects/armadillo/armadillo.obj"], ["extra/../../evil.txt"]])
@pytest.mark.xfail(strict=True, raises=pytest.fail.Exception, reason="row 12: downloads are not checked")
def test_another_archive_is_refused(server, names, tmp_path, monkeypatch):
    server.content = archive(*names)
    known = replace(datasets.DATASETS["famous"], url=server.url)
    monkeypatch.setitem(datasets.DATASETS, "famous", known)
    with pytest.raises(InputError):
        datasets.download_dataset("famous", tmp_path / "out")


@pytest.mark.xfail(strict=True, raises=pytest.fail.Exception, reason="row 12: junk is kept in the cache")
def test_other_weights_are_refused_and_not_kept(server, tmp_path, monkeypatch):
    server.content = b"junk"
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(image, "_SOURCES", (server.url, server.url))
    with pytest.raises(InputError):
        image.find_lpips_weights("download")


@pytest.mark.xfail(strict=True, raises=AssertionError, reason="row 12: a predictable name is written through")
def test_a_link_in_the_place_of_the_archive_is_not_followed(server, tmp_path, monkeypatch):
    server.content = archive("extra.txt")
    monkeypatch.setitem(datasets.DATASETS, "famous", replace(datasets.DATASETS["famous"], url=server.url))
    (tmp_path / "precious").write_text("mine")
    (tmp_path / ".famous.zip").symlink_to(tmp_path / "precious")
    with contextlib.suppress(InputError):
        datasets.download_dataset("famous", tmp_path)
    assert (tmp_path / "precious").read_bytes() == b"mine"


@pytest.mark.xfail(strict=True, raises=pytest.fail.Exception, reason="row 12: kernels of others are run")
def test_a_kernel_cache_that_others_can_write_to_is_refused(tmp_path, monkeypatch):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    monkeypatch.setenv("ETSPLAT_CACHE_DIR", str(tmp_path / "open"))
    with pytest.raises(InputError):
        cache_folder()
