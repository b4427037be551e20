"""Replay of a recorded force session."""

from collections import deque
from collections.abc import Callable

from gausim.core import DataError, Trajectory
from gausim.interaction.interaction import Interaction
from gausim.interaction.session import ForceSession

# Largest memory of a trajectory [bytes].
_MOST_BYTES = 8 << 30


def replay(
    interaction: Interaction,
    session: ForceSession,
    *,
    other_model: bool = False,
    watch: Callable[[Interaction], None] | None = None,
) -> Trajectory:
    """Replays a session from the initial state; all frames equal the recorded ones bit for bit.

    Args:
        interaction: the simulation, which begins a new session.
        session: the events to replay.
        other_model: accept another method or initial state than those of the session; results then differ.
        watch: called with the interaction before every step, after its events, and after the last step.

    Raises:
        DataError: the session is of another scene, frame rate, method or initial state, or its frames exceed 8 GiB.
        ConfigError: an event cannot be applied.
        DivergenceError: the simulation diverges where the recorded one did not.
    """
    wrong = session.differences(interaction.made_with, interaction.fps)
    if wrong and not (other_model and all(allowed for _, allowed in wrong)):
        raise DataError("session: " + "; ".join(text for text, _ in wrong) + ". Replay it with what it was made with.")
    frame = interaction.frame
    size = session.steps * 4 * (frame.positions.numel() + 2 * frame.deformation_gradients.numel())
    if size > _MOST_BYTES:
        raise DataError(f"session: its {session.steps} frames take {size >> 30} GiB, expected at most 8. Shorten it.")
    interaction.gravity, interaction.seed = session.gravity, session.seed
    interaction.restart()
    frames, pending = [interaction.frame], deque(session.entries)
    for tick in range(session.steps + 1):
        while pending and pending[0].at == tick:
            interaction.act(pending.popleft().event)
        if watch is not None:
            watch(interaction)
        if tick < session.steps:
            frames.append(interaction.step())
    return interaction.trajectory(frames)
