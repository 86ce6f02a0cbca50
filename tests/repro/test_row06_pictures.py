"""A picture is what its kind may be, and nothing is started or unpacked for another one."""

import io

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from etsplat.core.errors import InputError
from etsplat.io.images import load_image

EPS = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 32 24
%%EndComments
showpage
%%EOF
"""


@pytest.mark.xfail(strict=True, raises=AssertionError, reason="row 6: PostScript starts Ghostscript")
def test_postscript_starts_no_program(tmp_path, monkeypatch):
    started = []

    def ghostscript(*arguments, **_):
        started.append(arguments)
        raise OSError("not started")

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", ghostscript)
    (tmp_path / "0001.jpg").write_bytes(EPS)
    with pytest.raises(InputError):
        load_image(tmp_path / "0001.jpg")
    assert started == []


@pytest.mark.parametrize("kind", ["TIFF", "GIF", "BMP", "TGA", "JPEG2000", "PPM", "ICO", "PCX", "SGI"])
@pytest.mark.xfail(strict=True, raises=pytest.fail.Exception, reason="row 6: 0001.jpg may be any format of Pillow")
def test_a_jpeg_file_holds_jpeg(tmp_path, kind):
    buffer = io.BytesIO()
    try:
        Image.fromarray(np.full((24, 32, 3), 90, np.uint8)).save(buffer, kind)
    except OSError as error:  # Pillow was built without it
        pytest.fail(f"cannot be tried here: {error}")
    (tmp_path / "0001.jpg").write_bytes(buffer.getvalue())
    with pytest.raises(InputError):
        load_image(tmp_path / "0001.jpg")
