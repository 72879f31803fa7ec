"""All parameters of the method: one frozen model a stage, defaults that work, the paper's value beside ours."""

from schemas.config.attribution import AttributionParams
from schemas.config.decomposition import DecompositionParams
from schemas.config.flow import FlowParams
from schemas.config.ground import GroundParams
from schemas.config.joining import JoiningParams
from schemas.config.labeling import PLACES, LabelingConfig, hash_values
from schemas.config.profiles import PROFILES, our_steps, resolve_config
from schemas.config.proposals import ProposalParams
from schemas.config.refinement import RefinementParams
from schemas.config.registration import RegistrationParams
from schemas.config.static import StaticParams
from schemas.config.tracking import TrackingParams

__all__ = [
    "PLACES",
    "PROFILES",
    "AttributionParams",
    "DecompositionParams",
    "FlowParams",
    "GroundParams",
    "JoiningParams",
    "LabelingConfig",
    "ProposalParams",
    "RefinementParams",
    "RegistrationParams",
    "StaticParams",
    "TrackingParams",
    "hash_values",
    "our_steps",
    "resolve_config",
]
