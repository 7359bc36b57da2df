"""Curves, maps and bars: what is in them. How they look was judged by eye."""

import io

import numpy as np

from benchmarks import charts


def test_curves() -> None:
    x = np.array([1.0, 10.0, 100.0])
    panels = {
        "one": [charts.Curve("a", x, 0.5 * x, 2 * x), charts.Curve("b", x**2, colour=1, dashed=True)],
        "two": [charts.Curve("a", 3 * x)],
        "three": [],
    }
    figure = charts.plot_curves(
        x, panels, xlabel="s", ylabel="m", title="t", columns=2, notes={"three": "nothing"}
    )
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title() for axes in shown] == ["one", "two", "three"]
    assert [line.get_linestyle() for line in shown[0].lines] == ["-", "--"]
    assert len(shown[0].collections) == 1
    assert shown[0].get_xscale() == "log"
    assert [text.get_text() for text in shown[2].texts] == ["nothing"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]
    assert legend.get_title().get_text() == "t"
    single = charts.plot_curves(x, {"one": panels["two"]}, xlabel="", ylabel="", title="t", log=False)
    assert single.get_suptitle() == "t"
    assert single.axes[0].get_yscale() == "linear"


def test_maps_show_every_number() -> None:
    maps = {"left": [[1.0, 2.0], [np.nan, 4.0]], "right": [[5.0, 6.0], [7.0, 8.0]]}
    figure = charts.plot_maps(
        maps, columns=["a", "b"], rows=["c", "d"], xlabel="x", ylabel="y", unit="mm", log=True
    )
    left, right, bar = figure.axes
    assert [text.get_text() for text in left.texts] == ["1", "2", "4"]
    assert [text.get_text() for text in right.texts] == ["5", "6", "7", "8"]
    assert bar.get_ylabel() == "mm"
    assert left.images[0].norm is right.images[0].norm


def test_bars_show_means_and_samples() -> None:
    bars = {"force": {"exact": [np.array([1.0, 3.0])], "found": [np.array([2.0, 2.0])]}}
    figure = charts.plot_bars(["A"], bars, ylabels={"force": "N"})
    (axes,) = figure.axes
    assert [patch.get_height() for patch in axes.patches] == [2.0, 2.0]
    assert axes.get_ylabel() == "N"
    samples = [line for line in axes.lines if line.get_marker() == "."]
    np.testing.assert_array_equal([line.get_ydata() for line in samples], [[1, 3], [2, 2]])
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=50)
    assert file.getvalue().startswith(b"\x89PNG")
