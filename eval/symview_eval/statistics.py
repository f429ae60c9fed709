"""Success rates and their confidence intervals."""

from __future__ import annotations

from dataclasses import dataclass

from scipy import stats


@dataclass(frozen=True)
class SuccessRate:
    """Success rate of a number of episodes, with its 95 % Wilson interval; rate and interval are in [0, 1]."""

    successes: int
    episodes: int

    def __post_init__(self) -> None:
        if not 0 <= self.successes <= self.episodes or self.episodes == 0:
            raise ValueError(f"{self.successes} successes in {self.episodes} episodes is not a rate")

    @property
    def rate(self) -> float:
        """Fraction of successful episodes."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson confidence interval (low, high), inside [0, 1]."""
        interval = stats.binomtest(self.successes, self.episodes).proportion_ci(method="wilson")
        return float(interval.low), float(interval.high)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.rate:.0%} ({self.successes} of {self.episodes}; 95 % interval {low:.0%} to {high:.0%})"
