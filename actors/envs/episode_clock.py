"""Counts the steps of an episode of fixed length."""

from actors.envs.arguments import check_size


class EpisodeClock:
    """Says when an episode is cut off, and refuses a step outside of an episode.

    The tasks here have no end of their own: an episode is truncated at the horizon, never
    terminated, and a learner looks beyond its last step unless its preset says otherwise.
    """

    def __init__(self, horizon: int) -> None:
        """Begin outside of an episode.

        Args:
            horizon: steps in an episode.

        Raises:
            ValueError: the horizon is not a positive integer.
        """
        check_size("horizon", horizon, least=1)
        self.horizon = horizon
        self._remaining_steps = 0

    @property
    def steps_done(self) -> int:
        """Steps counted since the episode began; the horizon where none is running."""
        return self.horizon - self._remaining_steps

    def start(self) -> None:
        """Begin an episode."""
        self._remaining_steps = self.horizon

    def stop(self) -> None:
        """End the episode early."""
        self._remaining_steps = 0

    def check_running(self) -> None:
        """Check that a step may be made.

        Raises:
            RuntimeError: the environment was not reset, or the episode is over.
        """
        if self._remaining_steps == 0:
            raise RuntimeError(
                "step(): expected a running episode; got none, or one that is over; "
                "call reset() first"
            )

    def tick(self) -> bool:
        """Count one step; true where it was the last."""
        self._remaining_steps -= 1
        return self._remaining_steps == 0
