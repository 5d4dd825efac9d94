"""The upper half of the third part: measured and model, and the force that is missing.

A click into the upper chart marks a time; the lower one shows what the model lacks
there. The field for the time does the same for those who use no mouse.
"""

from nicegui import events, ui

from phsi_opt.force_analysis.units import spaced
from phsi_opt.page import charts
from phsi_opt.page.parts import card, choice, heading
from phsi_opt.page.session import Look, Session
from phsi_opt.page.snapshot import RunCurves, Snapshot, force_near
from phsi_opt.presentation.durations import TimeScale
from phsi_opt.presentation.numbers import number, said

CHART_HEIGHT = "height: 360px"
HOW_TO_LOOK = (
    "Click into a chart to see the missing force there; drag to zoom, double-click to "
    "see all."
)
FORCE_HEIGHT = "height: 260px"


class FitView:
    """Draws one run of a snapshot, and the missing force along it.

    Args:
        session: whose snapshot it is.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    @property
    def _look(self) -> Look:
        return self._session.look

    def build(self, snapshot: Snapshot) -> None:
        """Draw both charts."""
        with card():
            heading("Measured and model")
            self._choices(snapshot)
            self.overlay()
            ui.label(HOW_TO_LOOK).classes("faint")
        with card():
            heading("The missing force")
            self.force()

    @property
    def _shown(self) -> RunCurves | None:
        if self._session.snapshot is None:
            return None
        return self._session.snapshot.runs[self._look.run]

    def _choices(self, snapshot: Snapshot) -> None:
        titles = {number: run.title for number, run in enumerate(snapshot.runs)}
        names = [channel.name for channel in snapshot.runs[self._look.run].channels]
        if self._look.channel not in names:
            self._look.channel = snapshot.worst_channel(self._look.run)
        with ui.element("div").classes("fields"):
            choice("run", titles, self._look.run, self._set_run, width="15em")
            if len(names) > 1:
                choice("channel", names, self._look.channel, self._set_channel)
            self._time_field()

    @property
    def _scale(self) -> TimeScale:
        """The unit in which the times of the run are told."""
        run = self._shown
        snapshot = self._session.snapshot
        if run is None or snapshot is None:
            return TimeScale("", 1.0)
        return charts.scale_of_run(run, snapshot.t_unit)

    @property
    def _is_worst(self) -> bool:
        """Whether the time that is marked is the one that the diagnosis names."""
        snapshot = self._session.snapshot
        if snapshot is None or self._look.t is None:
            return False
        return (self._look.run, self._look.t) == (
            snapshot.first_run,
            snapshot.first_time,
        )

    def _set_run(self, run: int) -> None:
        self._look.run = run
        self._look.t = None
        self._field.set_value(None)
        self.overlay.refresh()
        self.force.refresh()

    def _set_channel(self, name: str) -> None:
        self._look.channel = name
        self.overlay.refresh()

    def _time_field(self) -> None:
        t = self._look.t
        scale = self._scale
        field = ui.number(
            _labelled("look at the time", scale.unit),
            value=None if t is None else float(f"{t / scale.size:.6g}"),
            on_change=lambda e: self._look_at(e.value),
        )
        field.props("dense outlined debounce=400").style("width: 12em")
        self._field = field

    def _look_at(self, t: float | None) -> None:
        self._look.t = None if t is None else t * self._scale.size
        self.overlay.refresh()
        self.force.refresh()

    def _click(self, e: events.GenericEventArguments) -> None:
        points = e.args.get("points") or []
        if points:
            self._field.set_value(float(points[0]["x"]))

    def _at_the_mark(self, snapshot: Snapshot, run: RunCurves) -> None:
        """What is missing at the time that is marked, beside the chart."""
        t = self._look.t
        if t is None:
            return
        with ui.element("div").props('role="status"'):
            if not run.holds(t):
                size = self._scale.size
                unit = spaced(self._scale.unit)
                begin, end, asked = (number(one / size) for one in (*run.t[[0, -1]], t))
                ui.label(
                    f"{run.name} was measured from t = {begin} to {end}{unit}; "
                    f"there is nothing at {asked}{unit}."
                ).classes("bad")
                return
            for curve in snapshot.forces_along(run):
                near = force_near(curve, t, snapshot.t_unit)
                ui.label(said(near)).style("font-weight: 600")

    def _mark(self, run: RunCurves) -> float | None:
        """The time that is marked, where the run has it."""
        t = self._look.t
        return t if t is not None and run.holds(t) else None

    @ui.refreshable_method
    def overlay(self) -> None:
        """Measured and free run, with the residual."""
        run = self._shown
        snapshot = self._session.snapshot
        if run is None or snapshot is None:
            return
        name = self._look.channel
        channel = next(one for one in run.channels if one.name == name)
        figure = charts.free_run(
            run, channel, snapshot.t_unit, self._mark(run), self._is_worst
        )
        label = f"Chart: {channel.name} of {run.title}, measured and model"
        plot = ui.plotly(figure).classes("w-full").style(CHART_HEIGHT)
        plot.props('role="img"').props["aria-label"] = label
        plot.on("plotly_click", self._click)
        self._at_the_mark(snapshot, run)

    @ui.refreshable_method
    def force(self) -> None:
        """What the model lacks along this run, and at the time that is marked."""
        run = self._shown
        snapshot = self._session.snapshot
        if run is None or snapshot is None:
            return
        curves = snapshot.forces_along(run)
        figure = charts.missing_force(
            curves, snapshot.t_unit, self._mark(run), self._is_worst
        )
        plot = ui.plotly(figure).classes("w-full").style(FORCE_HEIGHT)
        plot.props('role="img" aria-label="Chart: the missing force over time"')
        plot.on("plotly_click", self._click)


def _labelled(text: str, unit: str) -> str:
    """A label with the unit of the times."""
    return f"{text} ({unit})" if unit else text
