"""A callback for tests."""


class Rows(list):
    """Keeps the metrics of reports, without times."""

    def on_report(self, trainer, metrics):
        self.append({name: x for name, x in metrics.items() if not name.startswith("perf/")})
