"""What would run, as tables."""

from rich.box import SIMPLE
from rich.table import Table

from tilestream.pipeline.engine.plan import Plan, megabytes


def plan_table(plan: Plan) -> Table:
    """The stages of a plan with their tasks and promised memory."""
    table = Table(title="plan", title_justify="left", box=SIMPLE)
    for column in ("stage", "tasks", "promised memory per task"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    for stage, count, promise in plan.describe():
        table.add_row(stage, str(count), megabytes(promise))
    return table


def forecast_table(rows: list[dict[str, object]]) -> Table:
    """The same for people."""
    table = Table(title="plan", title_justify="left", box=SIMPLE)
    table.add_column("stage")
    for column in ("tasks", "work", "to do", "memory per task", "core-hours"):
        table.add_column(column, justify="right")
    table.add_column("after")
    for row in rows:
        after = ", ".join(row["after"]) if isinstance(row["after"], list) else ""
        memory = megabytes(int(str(row["promised_bytes"])))
        hours = f"{float(str(row['core_hours'])):.3f}"
        work, left = (f"{row[name]:,}" for name in ("work", "to_do"))
        table.add_row(str(row["stage"]), str(row["tasks"]), work, left, memory, hours, after)
    total = sum(float(str(row["core_hours"])) for row in rows)
    table.add_row(
        "all", str(sum(int(str(row["tasks"])) for row in rows)), "", "", "", f"{total:.3f}", ""
    )
    return table
