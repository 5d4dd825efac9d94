"""The upper half of the third part: measured and model, and the force that is missing.

A click into the upper chart marks a time; the lower one shows what the model lacks
there. The field for the time does the same for those who use no mouse.
"""

from nicegui import events, ui

from phsi_opt.page import charts
from phsi_opt.page.parts import card, choice, heading
from phsi_opt.page.session import Session
from phsi_opt.page.snapshot import RunCurves, Snapshot, force_near

CHART_HEIGHT = "height: 360px"
FORCE_HEIGHT = "height: 260px"


class FitView:
    """Draws one run of a snapshot, and the missing force along it.

    Args:
        session: whose snapshot it is.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._run = 0
        self._channel = ""
        self._t: float | None = None
        self._snapshot: Snapshot | None = None

    def build(self, snapshot: Snapshot) -> None:
        """Draw both charts."""
        known = self._snapshot
        if known is None or len(known.runs) != len(snapshot.runs):
            self._run = snapshot.worst_run
            self._t = None
        self._snapshot = snapshot
        with card():
            heading("Measured and model")
            self._choices(snapshot)
            self.overlay()
        with card():
            heading("The missing force")
            self._time_field()
            self.force()

    @property
    def _shown(self) -> RunCurves | None:
        if self._snapshot is None:
            return None
        return self._snapshot.runs[self._run]

    def _choices(self, snapshot: Snapshot) -> None:
        titles = {number: run.title for number, run in enumerate(snapshot.runs)}
        names = [channel.name for channel in snapshot.runs[self._run].channels]
        if self._channel not in names:
            self._channel = names[0]
        with ui.element("div").classes("fields"):
            choice("run", titles, self._run, self._set_run, width="15em")
            if len(names) > 1:
                choice("channel", names, self._channel, self._set_channel)
        ui.label(
            "Click where it fails to see the missing force there; drag to zoom, "
            "double-click to see all."
        ).classes("faint")

    def _set_run(self, run: int) -> None:
        self._run = run
        self._t = None
        self.overlay.refresh()
        self.force.refresh()

    def _set_channel(self, name: str) -> None:
        self._channel = name
        self.overlay.refresh()

    def _time_field(self) -> None:
        field = ui.number(
            "look at the time",
            value=self._t,
            on_change=lambda e: self._look_at(e.value),
        )
        field.props("dense outlined debounce=400").style("width: 12em")
        self._field = field

    def _look_at(self, t: float | None) -> None:
        self._t = t
        self.overlay.refresh()
        self.force.refresh()

    def _click(self, e: events.GenericEventArguments) -> None:
        points = e.args.get("points") or []
        if points:
            self._field.set_value(float(points[0]["x"]))

    @ui.refreshable_method
    def overlay(self) -> None:
        """Measured and free run, with the residual."""
        run = self._shown
        if run is None or self._snapshot is None:
            return
        channel = next(one for one in run.channels if one.name == self._channel)
        figure = charts.free_run(run, channel, self._snapshot.t_unit, self._t)
        label = f"Chart: {channel.name} of {run.title}, measured and model"
        plot = ui.plotly(figure).classes("w-full").style(CHART_HEIGHT)
        plot.props(f'role="img" aria-label="{_plain(label)}"')
        plot.on("plotly_click", self._click)

    @ui.refreshable_method
    def force(self) -> None:
        """What the model lacks along this run, and at the time that is marked."""
        run = self._shown
        snapshot = self._snapshot
        if run is None or snapshot is None:
            return
        curves = snapshot.forces_along(run)
        if self._t is not None:
            with ui.element("div").props('role="status"'):
                for curve in curves:
                    ui.label(force_near(curve, self._t)).style("font-weight: 600")
        figure = charts.missing_force(curves, snapshot.t_unit, self._t)
        plot = ui.plotly(figure).classes("w-full").style(FORCE_HEIGHT)
        plot.props('role="img" aria-label="Chart: the missing force over time"')


def _plain(text: str) -> str:
    """A text that may stand in an attribute."""
    return text.replace('"', "'")
