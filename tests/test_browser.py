"""The browser of tests/browser.py sees what a page should not do, and has WebGL."""

from __future__ import annotations

from browser import watched


def test_errors_and_requests_are_seen(browser, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(
        '<script>console.error("a"); setTimeout(() => b.c)</script><img src="http://example.invalid/x.png">'
    )
    with watched(browser) as seen:
        seen.page.goto(path.as_uri())
        seen.page.wait_for_timeout(200)
        assert any("a" == text for text in seen.errors)
        assert any("b is not defined" in text for text in seen.errors)
        assert seen.requests == ["http://example.invalid/x.png"]


def test_a_canvas_draws_with_webgl(browser):
    with watched(browser) as seen:
        pixel = seen.page.evaluate(
            """() => {
              const gl = document.createElement("canvas").getContext("webgl");
              gl.clearColor(0, 1, 0, 1); gl.clear(gl.COLOR_BUFFER_BIT);
              const pixel = new Uint8Array(4); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
              return [...pixel];
            }"""
        )
        assert pixel == [0, 255, 0, 255]
