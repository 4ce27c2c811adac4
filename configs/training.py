"""The settings of the training, in groups; each of the paper's terms has one of its own."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from configs.section import Section

# Bounds that are far above what anybody needs: they keep slips, as a zero too many or an exponent, from hours of work
# and from the machine's memory.
MOST_SEED = 2**31 - 1  # COLMAP's are 32 bits wide
MOST_PHOTOS = 1_000_000
MOST_STEPS = 100_000_000
MOST_POINTS = 2**20  # rays or points in one step
MOST_SAMPLES = 4096  # on one ray
MOST_WIDTH = 4096  # of a layer
MOST_WEIGHT = 10_000.0
LEAST_LENGTH = 1e-6  # scene units: float32 tells nothing finer apart
MOST_STEP_GIB = 1024


class FieldParams(Section):
    """The networks: what is trained."""

    encoding: Literal["hash", "frequency"] = Field("hash", description="encoding of positions for the SDF")
    levels: int = Field(8, ge=1, le=24, description="levels of the SDF's hash encoding, or its frequencies")
    level_features: int = Field(4, ge=1, le=8, description="features per level; CPU kernels exist for 4")
    log2_rows: int = Field(17, ge=8, le=24, description="a level has at most two to this power rows")
    coarsest: int = Field(16, ge=2, le=8192, description="cells along a side of the coarsest level")
    finest: int = Field(512, ge=4, le=8192, description="cells along a side of the finest level")
    sdf_layers: int = Field(1, ge=1, le=16, description="hidden layers of the SDF's MLP")
    sdf_width: int = Field(64, ge=4, le=MOST_WIDTH, description="width of the SDF's hidden layers")
    radiance_layers: int = Field(2, ge=1, le=16, description="hidden layers of the radiance MLP")
    radiance_width: int = Field(
        64, ge=4, le=MOST_WIDTH, description="width of the radiance MLP's hidden layers, and of the others"
    )
    radiance_inputs: Literal["view", "reflected"] = Field(
        "reflected",
        description="what the radiance MLP knows of the view: its direction, or the reflected one and n.v too",
    )
    colors: Literal["shaded", "network"] = Field(
        "shaded",
        description="shaded: albedo times the light that normal and surroundings let in, and the radiance MLP where "
        "that does not explain the photos; network: the radiance MLP alone",
    )
    gradients: Literal["analytic", "numerical"] = Field(
        "analytic", description="SDF gradients by differentiation, or central differences one active voxel to each side"
    )
    sphere_radius: float = Field(0.5, gt=0, lt=1, description="the SDF is this sphere before training, scene units")
    init: Literal["auto", "sphere", "room", "hull"] = Field(
        "auto",
        description="the SDF before training: that sphere, a room around the cameras, or the visual hull of masks (one "
        "for each photo); auto: a room where most cameras stand in that sphere, else it",
    )
    background: bool = Field(True, description="model what lies outside the region (never where the masks alone count)")
    background_log2_rows: int = Field(15, ge=8, le=24, description="rows per level of the background's encoding")


class DensityParams(Section):
    """How opaque the signed distance is."""

    form: Literal["laplace", "neus"] = Field(
        "laplace", description="optical depth from the SDF: Laplace CDF (VolSDF), or the logistic alpha of NeuS"
    )
    scale: Literal["scheduled", "learned"] = Field("scheduled", description="how the density's scale b gets its value")
    scale_start: float = Field(0.05, ge=LEAST_LENGTH, le=10, description="scale b at the start, scene units")
    scale_end: float = Field(
        0.002, ge=LEAST_LENGTH, le=10, description="scheduled scale b at the end, scene units; never under half a voxel"
    )
    outlines_from: float = Field(
        0.3,
        ge=0,
        le=1,
        description="progress from which the density of what is shiny lets rays pass beside it, so that it is as large "
        "as its outlines: holes have to be open by then",
    )
    outlines_until: float = Field(0.6, ge=0, le=1, description="progress at which it does so in full")
    sharpen_until: float = Field(0.9, gt=0, le=1, description="progress at which the scheduled scale is at its end")


class SamplingParams(Section):
    """Where a step looks."""

    rays: int = Field(512, ge=1, le=MOST_POINTS, description="rays per step")
    samples: int = Field(16, ge=2, le=MOST_SAMPLES, description="samples per ray inside the region of interest")
    samples_end: int = Field(
        12,
        ge=2,
        le=MOST_SAMPLES,
        description="samples per ray once the density is sharp, fewer and fewer from 0.3 of the budget on",
    )
    needed_share: float = Field(
        0.7, ge=0, le=1, description="part of the rays that goes where the surface is, and where colours are met worse"
    )
    free_points: int = Field(
        256, ge=0, le=MOST_POINTS, description="points per step anywhere in the region, for the Eikonal term"
    )
    background_samples: int = Field(8, ge=1, le=MOST_SAMPLES, description="samples per ray outside the region")
    sampler: Literal["grid", "proposal"] = Field(
        "grid", description="where samples go: near the surface of a cached grid, or as a proposal network says"
    )
    cache_resolution: int = Field(96, ge=8, le=512, description="side of the SDF grid that guides sampling")
    cache_every: int = Field(64, ge=1, le=MOST_STEPS, description="steps between refreshes of that grid")
    proposal_samples: int = Field(64, ge=2, le=MOST_SAMPLES, description="samples per ray of the proposal network")
    proposal_updates: int = Field(
        128,
        ge=0,
        le=MOST_STEPS,
        description="steps at the start that each train the proposal network; later every fifth does",
    )


class ScheduleParams(Section):
    """Coarse to fine, and learning rates."""

    start_levels: int = Field(4, ge=1, le=24, description="levels of the encoding in use at the start")
    coarse_until: float = Field(0.4, ge=0, le=1, description="progress at which all levels are in use")
    deferred_from: float | None = Field(
        0.3,
        ge=0,
        le=1,
        description="progress from which a ray has one colour, at its mean point, not one for each sample; null: never",
    )
    lr_table: float = Field(1e-2, gt=0, le=10, description="peak learning rate of the hash tables")
    lr_network: float = Field(3e-3, gt=0, le=10, description="peak learning rate of the networks")
    lr_warm_up: float = Field(0.02, ge=0, lt=1, description="progress at which the peak rate is reached")
    lr_decay: Literal["cosine", "exponential"] = Field("cosine", description="how the rate falls after that")
    lr_final: float = Field(0.03, gt=0, le=1, description="rate at the end as a part of the peak")
    adam_beta2: float = Field(0.99, gt=0, lt=1, description="Adam's decay of the squared gradients")


class LossParams(Section):
    """What a step lowers besides the colour error, each by its weight."""

    eikonal: float = Field(0.1, ge=0, le=MOST_WEIGHT, description="weight of the Eikonal term")
    mask: float = Field(0.1, ge=0, le=MOST_WEIGHT, description="weight of the mask term, where the masks alone count")
    exposure: float = Field(0.1, ge=0, le=MOST_WEIGHT, description="weight that holds the photos' gains at 1")
    gloss: float = Field(
        0.01, ge=0, le=MOST_WEIGHT, description="weight of what is not shaded in the colours, which holds them to be"
    )
    sparse: float = Field(1.0, ge=0, le=MOST_WEIGHT, description="weight of the SfM points' terms, faded out")
    sparse_until: float = Field(0.8, ge=0, le=1, description="progress at which the SfM points' term is gone")
    sparse_tolerance: float = Field(
        0.005, ge=LEAST_LENGTH, le=10, description="SfM points off by this count linearly, scene units"
    )
    sparse_step: float = Field(
        0.01,
        ge=0,
        le=10,
        description="the SDF must have changed sign this far before and behind SfM points, scene units",
    )
    sparse_batch: int = Field(256, ge=0, le=MOST_POINTS, description="sightings of SfM points per step")
    dense: float = Field(
        3.0, ge=0, le=MOST_WEIGHT, description="weight of the dense stereo points' terms, times each point's trust"
    )
    dense_tolerance: float = Field(
        0.003, ge=LEAST_LENGTH, le=10, description="dense points off by this count linearly, scene units"
    )
    dense_step: float = Field(
        0.01,
        ge=0,
        le=10,
        description="the SDF must have changed sign this far before and behind dense points, scene units",
    )
    dense_batch: int = Field(512, ge=0, le=MOST_POINTS, description="sightings of dense points per step")


class AmbiguityParams(Section):
    """The paper's ambiguity weight: trust photos less where the others that see a place disagree with them."""

    form: Literal["off", "paper", "stable"] = Field("off", description="off, as the paper writes it, or stable")
    start: float = Field(0.2, ge=0, le=1, description="progress at which the stable form begins")
    visibility: Literal["network", "paper", "stable", "mesh"] = Field(
        "stable",
        description="how it finds out which photos see a place: the paper's product over the SDF network or (`paper`) "
        "over its cached grid, the smallest SDF on the path, or rays cast at a mesh",
    )
    sharpness: float = Field(
        100.0, gt=0, le=1e6, description="sigmoid sharpness beta of the visibility, per scene unit"
    )
    samples: int = Field(
        64, ge=2, le=MOST_SAMPLES, description="samples on a path; the CPU's stable form traces instead"
    )


class ReflectionParams(Section):
    """The paper's self-reflection: explain what a surface mirrors of the object itself by a second surface."""

    form: Literal["off", "paper", "stable"] = Field("off", description="off, as the paper writes it, or stable")
    start: float = Field(0.3, ge=0, le=1, description="progress at which the stable form begins")
    reach: float = Field(0.1, ge=LEAST_LENGTH, le=10, description="length t_max of reflected rays, scene units")
    samples: int = Field(16, ge=2, le=MOST_SAMPLES, description="samples on a reflected ray")
    temperature: float = Field(
        10.0, gt=0, le=1e6, description="the paper's form: inverse scale of its Laplace CDF, per scene unit"
    )


class PlanarParams(Section):
    """The planar term: hold the surface to be flat where photos show one even colour."""

    form: Literal["off", "paper", "stable"] = Field("stable", description="off, as the paper writes it, or stable")
    weight: float = Field(0.1, ge=0, le=MOST_WEIGHT, description="weight of the planar term")
    start: float = Field(
        0.5, ge=0, le=1, description="progress at which the stable form begins: holes have to be open by then"
    )
    radius: float = Field(0.05, ge=LEAST_LENGTH, le=10, description="reach of the planar term, scene units")
    rays: int = Field(256, ge=1, le=MOST_POINTS, description="rays per step that the planar term looks at")
    neighbors: int = Field(4, ge=1, le=256, description="the paper's form: places before each of their surface points")
    features: Literal["radiance", "mlp"] = Field(
        "radiance",
        description="appearance features of the paper's form and of the Eikonal term: those that the radiance MLP "
        "gets, or those of an MLP of its own",
    )
    scale_start: float = Field(
        0.1, gt=0, le=1, description="the paper's form: lambda_pla is scaled by this at the start and by 1 later"
    )
    scale_until: float = Field(
        1.0, gt=0, le=1, description="the paper's form: progress from which lambda_pla is not scaled down"
    )


class EikonalParams(Section):
    """The paper's relaxed Eikonal term: hold the SDF's gradient to length 1 less where the photos are not met yet."""

    form: Literal["plain", "paper", "stable"] = Field(
        "plain", description="evenly held everywhere, relaxed as the paper writes it, or stable"
    )
    gamma: float = Field(5.0, ge=0, le=1e4, description="how fast colour error relaxes the Eikonal term")
    clip: float = Field(0.2, ge=LEAST_LENGTH, le=10, description="colour error from which it relaxes no further")


class TermParams(Section):
    """The paper's terms; only the planar one is on by default."""

    ambiguity: AmbiguityParams = AmbiguityParams()
    reflection: ReflectionParams = ReflectionParams()
    planar: PlanarParams = PlanarParams()
    eikonal: EikonalParams = EikonalParams()


class TrainParams(Section):
    """Posed images to a neural signed distance field."""

    steps: int = Field(
        8000,
        ge=1,
        le=MOST_STEPS,
        description="optimiser steps where stereo covers nothing (ignored where `minutes` is set)",
    )
    steps_if_covered: float = Field(
        0.25,
        gt=0,
        le=1,
        description="part of `steps` that is enough where trusted dense points cover all of the surface; in between by "
        "the share that they cover. 1: always `steps`",
    )
    minutes: float | None = Field(None, gt=0, le=1_000_000, description="wall-clock budget in minutes instead of steps")
    seed: int = Field(0, ge=0, le=MOST_SEED, description="random seed")
    hold_out: int = Field(
        0,
        ge=0,
        le=MOST_PHOTOS,
        description="hold every n-th photo out of training and texture, and report the PSNR on those; 0: none",
    )
    preview_every: float = Field(0.25, gt=0, le=1, description="progress between preview renders")
    evidence: bool = Field(
        True,
        description="let dense stereo tell what is shiny, so that outlines and not reflections count there, and where "
        "photos agree on the surface, which needs no help then; false: all counts alike everywhere",
    )
    precision: Literal["auto", "float32", "mixed"] = Field(
        "auto",
        description="matrix products of the networks: float32, or bfloat16 for colours and, on CUDA, TF32 for the "
        "distance; auto: mixed on CUDA only, from Ampere on",
    )
    backbone: Literal["hineus", "neus2", "hfneus", "neuralangelo"] = Field(
        "hineus", description="set density, gradients, encoding and schedules as that method does; what is named wins"
    )

    field: FieldParams = FieldParams()
    density: DensityParams = DensityParams()
    sampling: SamplingParams = SamplingParams()
    schedule: ScheduleParams = ScheduleParams()
    losses: LossParams = LossParams()
    terms: TermParams = TermParams()

    @model_validator(mode="after")
    def _fits_some_machine(self) -> TrainParams:
        gib = self.least_bytes() / 2**30
        if gib > MOST_STEP_GIB:
            raise ValueError(
                f"rays x samples x width and the encoding's rows of `train` would take {gib:,.0f} GiB of memory, and "
                f"{MOST_STEP_GIB:,} are the most; lower `train.sampling.rays`, `train.sampling.samples` or "
                "`train.field.sdf_width`"
            )
        return self

    def least_bytes(self) -> int:
        """Memory that training takes at the very least: the tables with their gradients and Adam's two means of them,
        and what the hidden layers hold of each sample of a step until the way back."""
        field, sampling = self.field, self.sampling
        rows = field.levels * 2**field.log2_rows if field.encoding == "hash" else 0
        samples = sampling.rays * max(sampling.samples, sampling.samples_end) + sampling.free_points
        numbers = field.sdf_layers * field.sdf_width + field.radiance_layers * field.radiance_width
        return 4 * (4 * rows * field.level_features + samples * numbers)
