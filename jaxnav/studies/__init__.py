"""Published systems as studies: a configuration, a simulation, methods, and claims with verdicts.

The registry is free of JAX, so that listing studies and parsing their options is immediate.
"""

from importlib import import_module
from typing import Any, NamedTuple


class Study(NamedTuple):
    """A study by name, its parts loaded on demand.

    Attributes:
        summary: One line.
        config: ``module:class`` of its configuration, free of JAX.
        entry: ``module:function`` with ``(config, progress) -> list[StudyResult]``.
        figures: ``module:function`` with ``(result, directory) -> list[Path]``.
        scenarios: ``module:mapping`` from scenario to one line, free of JAX.
        tuning: ``module:function`` with ``(config) -> Problem``, what can be tuned by gradient.
        check: ``module:function`` with ``(config)`` that raises what the study would refuse, before
            anything is written.
    """

    summary: str
    config: str
    entry: str
    figures: str
    scenarios: str
    tuning: str
    check: str

    def load(self, part: str) -> Any:
        """Return the object that one of the fields names."""
        module, name = getattr(self, part).split(":")
        return getattr(import_module(module), name)


STUDIES = {
    "immae": Study(
        summary="attitude of a sounding rocket by gyros and a star tracker, process noise unknown: "
        "a Kalman filter against banks of them (Si, Wang, Niu)",
        config="jaxnav.studies.immae.config:ImmaeConfig",
        entry="jaxnav.studies.immae.study:run_study",
        figures="jaxnav.studies.immae.figures:draw",
        scenarios="jaxnav.studies.immae.config:SCENARIOS",
        tuning="jaxnav.studies.immae.tuning:problem",
        check="jaxnav.studies.base:check_simulated",
    ),
    "mmae-ukf": Study(
        summary="attitude of a launcher by inertial sensors and a star tracker, noise changing: "
        "banks of extended and unscented filters (Zhao, Chen, He, Ge)",
        config="jaxnav.studies.mmae_ukf.config:MmaeUkfConfig",
        entry="jaxnav.studies.mmae_ukf.study:run_study",
        figures="jaxnav.studies.mmae_ukf.figures:draw",
        scenarios="jaxnav.studies.mmae_ukf.config:SCENARIOS",
        tuning="jaxnav.studies.mmae_ukf.tuning:problem",
        check="jaxnav.studies.base:check_simulated",
    ),
    "rkcns": Study(
        summary="position of a vehicle above the air by the refraction of starlight: "
        "iterated cubature filters (Shi, Chen, Wang)",
        config="jaxnav.studies.rkcns.config:RkcnsConfig",
        entry="jaxnav.studies.rkcns.study:run_study",
        figures="jaxnav.studies.rkcns.figures:draw",
        scenarios="jaxnav.studies.rkcns.config:SCENARIOS",
        tuning="jaxnav.studies.rkcns.tuning:problem",
        check="jaxnav.studies.rkcns.study:check",
    ),
    "arekf": Study(
        summary="a sounding rocket with cheap inertial sensors and GNSS, noise identified before "
        "launch, against robust, invariant and adaptive filters (Yang et al.)",
        config="jaxnav.studies.arekf.config:ArekfConfig",
        entry="jaxnav.studies.arekf.study:run_study",
        figures="jaxnav.studies.arekf.figures:draw",
        scenarios="jaxnav.studies.arekf.config:SCENARIOS",
        tuning="jaxnav.studies.arekf.tuning:problem",
        check="jaxnav.studies.base:check_simulated",
    ),
    "sage-husa": Study(
        summary="a vehicle with inertial sensors and GNSS whose fixes turn noisy: "
        "banks of filters that estimate the noise (Song et al.)",
        config="jaxnav.studies.sage_husa.config:SageHusaConfig",
        entry="jaxnav.studies.sage_husa.study:run_study",
        figures="jaxnav.studies.sage_husa.figures:draw",
        scenarios="jaxnav.studies.sage_husa.config:SCENARIOS",
        tuning="jaxnav.studies.sage_husa.tuning:problem",
        check="jaxnav.studies.base:check_simulated",
    ),
    "gnss-track": Study(
        summary="a recorded GNSS track through banks of constant-velocity filters, judged by "
        "how well they predict the next fix",
        config="jaxnav.studies.gnss_track.config:GnssTrackConfig",
        entry="jaxnav.studies.gnss_track.study:run_study",
        figures="jaxnav.studies.gnss_track.figures:draw",
        scenarios="jaxnav.studies.gnss_track.config:SCENARIOS",
        tuning="jaxnav.studies.gnss_track.tuning:problem",
        check="jaxnav.studies.gnss_track.study:check",
    ),
}
