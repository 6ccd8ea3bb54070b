"""Which way is up in a run, and how its Gaussians are turned for viewers that take another axis for up."""

from __future__ import annotations

from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.export.run_to_splats import Writing
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.motion import placement
from dyngs.output.aim import up_direction
from dyngs.output.job_of_run import cameras_for_paths
from dyngs.runs.checkpoint import LoadedRun
from dyngs.splats.rotation import AXES, axis_of, nearest_axis, turn_between


def up_of_run(run: LoadedRun) -> tuple[tuple[float, ...], str] | None:
    """Return the direction (3,) that is up in a run and what says so; None if nothing does.

    The person's body at rest, else the cameras of the capture: an axis where one is within 30 degrees.
    """
    person = avatar_of(run.scene)
    if person is not None:
        found, who = tuple(placement.up_direction(person.clip).tolist()), "the body at rest"
    else:
        try:
            cameras = cameras_for_paths(read_capture(run.config.data), run.config.data)
        except DyngsError:
            return None
        found, who = tuple(up_direction(cameras).tolist()), "the mean camera"
    name = nearest_axis(found)
    return (found if name is None else AXES[name]), who


def writing_of(
    run: LoadedRun, target: str, up: str | None = None, from_up: str | None = None, sh_degree: int | None = None
) -> tuple[Writing, str]:
    """Return how a run is written, and a line about which way is up in the file.

    Args:
        run: a trained model.
        target: axis that viewers of the format take for up.
        up: axis that is asked for instead; "keep": nothing is turned.
        from_up: axis that is up in the run; None: found as ``up_of_run`` does.
        sh_degree: degree of the harmonics in the file.

    Raises:
        DyngsError: no such axis.
    """
    if up == "keep":
        return Writing(sh_degree=sh_degree), "axes are those of the capture"
    found = (axis_of(from_up), "--from-up") if from_up is not None else up_of_run(run)
    wanted = target if up is None else up
    if found is None:
        line = "nothing says which way is up in this run, so axes are those of the capture; --from-up=AXIS tells it"
        return Writing(sh_degree=sh_degree), line
    direction, who = found
    name = nearest_axis(direction)
    here = name if name is not None and AXES[name] == tuple(direction) else "a slanted direction"
    turned = "the axes of the capture are kept" if here == wanted else f"turned, it was {here} in the capture"
    how = Writing(turn_between(direction, axis_of(wanted)), wanted, sh_degree)
    return how, f"up is {wanted} in the file ({turned}, says {who})"
