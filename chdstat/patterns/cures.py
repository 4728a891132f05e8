"""Cures in the words of the renderer that drew the samples: its own settings, and what each costs.

`CURES` is the table: for each renderer, what helps against each pattern. Names in braces are rows
of `SETTINGS`, so that a setting is named, placed in the interface and priced once. `cure_in` picks.
Names of settings and their places were checked in Blender 5.0.1, and names in LuxCore 2.11.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class NoiseSetting:
    """A setting of a renderer that changes noise.

    Attributes
    ----------
    name
        Its name in the interface, or in the scene file where there is none.
    does
        What it does against noise.
    cost
        What it costs: time, light or truth.
    where
        Its place in the interface; empty if the name says all.
    properties
        The properties that it sets in the renderer's own Python interface or scene file.
    """

    name: str
    does: str
    cost: str
    where: str = ""
    properties: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.name} ({self.where})" if self.where else self.name


_USUAL = "time only: half the noise takes four times the samples"
_RENDER, _LIGHT = "CyclesRenderSettings", "CyclesLightSettings"

_CYCLES = {
    "samples": NoiseSetting(
        "Max Samples",
        "averages more paths",
        _USUAL,
        "Render > Sampling > Render",
        (f"{_RENDER}.samples",),
    ),
    "threshold": NoiseSetting(
        "Noise Threshold",
        "stops early where a pixel looks clean, so that time goes to the others",
        "where bright paths are rare, pixels look clean too soon: raise Min Samples there",
        "Render > Sampling > Render",
        (
            f"{_RENDER}.use_adaptive_sampling",
            f"{_RENDER}.adaptive_threshold",
            f"{_RENDER}.adaptive_min_samples",
        ),
    ),
    "denoise": NoiseSetting(
        "Denoise",
        "smooths what is left",
        "fine detail; what no path has found stays missing, and fireflies may become blotches",
        "Render > Sampling > Render",
        (f"{_RENDER}.use_denoising",),
    ),
    "light_tree": NoiseSetting(
        "Light Tree",
        "at each place, draws lamps that matter there more often than others",
        "a little time per sample, no light; with one or two lamps, it gains little",
        "Render > Sampling > Lights",
        (f"{_RENDER}.use_light_tree",),
    ),
    "guiding": NoiseSetting(
        "Path Guiding",
        "learns while it renders where light comes from, and sends paths there",
        "time per sample, no light; on the CPU only",
        "Render > Sampling > Path Guiding",
        (f"{_RENDER}.use_guiding",),
    ),
    "portal": NoiseSetting(
        "Portal",
        "an area light in a window that sends paths out to the world",
        "a little time, no light; it must cover the window, gives no light of its own, and helps "
        "light of the world only, not that of lamps outside",
        "Light > Settings",
        (f"{_LIGHT}.is_portal",),
    ),
    "world": NoiseSetting(
        "Map Resolution",
        "with Sampling set to Manual, finds a small bright sun in the image of the world",
        "memory, and time before the render starts; no light",
        "World > Settings > Surface",
        ("CyclesWorldSettings.sampling_method", "CyclesWorldSettings.sample_map_resolution"),
    ),
    "multiple": NoiseSetting(
        "Multiple Importance",
        "counts a lamp that a path hits by chance, too: large lamps, sharp reflections of lamps",
        "a little time, no light; on unless you switched it off",
        "Light > Settings",
        (f"{_LIGHT}.use_multiple_importance_sampling",),
    ),
    "emission": NoiseSetting(
        "Emission Sampling",
        "aims at glowing objects as at lamps; None for those too weak to light anything",
        "no light; one that lights the scene and is set to None becomes noisy itself",
        "Material > Settings > Surface",
        ("CyclesMaterialSettings.emission_sampling",),
    ),
    "size": NoiseSetting(
        "Radius or Size of the lamp",
        "makes a lamp behind glass or in a mirror easier to hit",
        "the look: shadows and highlights become softer",
        "Light > Light",
        ("PointLight.shadow_soft_size", "AreaLight.size"),
    ),
    "shadow_caustics": NoiseSetting(
        "Shadow Caustics",
        "aims at lamps through curved glass",
        "time per sample; lamp, glass and what they light must each be set; it is an approximation "
        "that loses most of the light behind flat panes",
        "Light > Settings; Object > Shading > Caustics",
        (
            f"{_LIGHT}.is_caustics_light",
            "CyclesObjectSettings.is_caustics_caster",
            "CyclesObjectSettings.is_caustics_receiver",
        ),
    ),
    "clear_shadow": NoiseSetting(
        "Transparent BSDF for Is Shadow Ray of Light Path",
        "lets lamps shine through panes as if these were not there",
        "the look: no bright patterns; switch Refractive Caustics off, too, or light counts twice",
        "",
        ("ShaderNodeLightPath", "ShaderNodeBsdfTransparent"),
    ),
    "caustics": NoiseSetting(
        "Reflective and Refractive Caustics",
        "off, leave out light that reaches a matte surface by way of a mirror or glass",
        "light: the image becomes darker where it was lit so, also behind window panes",
        "Render > Light Paths > Caustics",
        (f"{_RENDER}.caustics_reflective", f"{_RENDER}.caustics_refractive"),
    ),
    "filter_glossy": NoiseSetting(
        "Filter Glossy",
        "treats mirrors and glass as rougher once a path has met a matte surface",
        "light and truth: it blurs what mirrors and glass throw on things, and loses part of it; "
        "it is on, at 1, in a new file",
        "Render > Light Paths > Caustics",
        (f"{_RENDER}.blur_glossy",),
    ),
    "clamping": NoiseSetting(
        "Clamping of Indirect Light",
        "cuts bright bounced light to its value",
        "light: what is cut is missing, so that the image becomes darker, most where it is noisy",
        "Render > Light Paths > Clamping",
        (f"{_RENDER}.sample_clamp_indirect", f"{_RENDER}.sample_clamp_direct"),
    ),
    "bounces": NoiseSetting(
        "Max Bounces",
        "more of them bring light, never less noise; fewer save time",
        "too few make rooms darker and glass black",
        "Render > Light Paths > Max Bounces",
        tuple(
            f"{_RENDER}.{kind}_bounces"
            for kind in ("max", "diffuse", "glossy", "transmission", "volume", "transparent_max")
        ),
    ),
    "volumes": NoiseSetting(
        "Biased, with Step Rate",
        "walks through smoke in steps instead of at random",
        "truth: large steps lose detail, small ones take time",
        "Render > Volumes",
        (f"{_RENDER}.volume_biased", f"{_RENDER}.volume_step_rate"),
    ),
}

_LUXCORE = {
    "samples": NoiseSetting(
        "batch.haltspp", "averages more paths", _USUAL, properties=("batch.haltspp",)
    ),
    "strategy": NoiseSetting(
        "lightstrategy.type",
        "POWER and LOG_POWER draw strong lights more often; DLS_CACHE learns which lights matter "
        "at each place",
        "no light; DLS_CACHE takes time before the render starts",
        properties=("lightstrategy.type",),
    ),
    "importance": NoiseSetting(
        "scene.lights.NAME.importance",
        "draws this light more often than the others",
        "no light; the other lights become noisier",
    ),
    "window": NoiseSetting(
        "scene.lights.NAME.visibilitymapcache.enable",
        "learns through which openings the sky is seen, and sends paths there",
        "time before the render starts, no light",
    ),
    "hybrid": NoiseSetting(
        "path.hybridbackforward.enable",
        "draws paths from the lights for caustics, beside those from the camera",
        "time per sample, no light",
        properties=("path.hybridbackforward.enable",),
    ),
    "photons": NoiseSetting(
        "path.photongi.caustic.enabled",
        "takes caustics from a map of photons",
        "truth: it blurs them; memory, and time before the render starts",
        properties=("path.photongi.caustic.enabled",),
    ),
    "cache": NoiseSetting(
        "path.photongi.indirect.enabled",
        "takes bounced light from a map of photons",
        "truth: it blurs light, and may leak through thin walls; time before the render starts",
        properties=("path.photongi.indirect.enabled",),
    ),
    "glass": NoiseSetting(
        "scene.materials.NAME.type = archglass",
        "lets lights shine through panes as if these did not bend them",
        "the look: such glass casts no bright patterns",
    ),
    "clamping": NoiseSetting(
        "path.clamping.variance.maxvalue",
        "cuts samples that are far brighter than their pixel",
        "light: what is cut is missing, so that the image becomes darker",
        properties=("path.clamping.variance.maxvalue",),
    ),
    "depth": NoiseSetting(
        "path.pathdepth.total",
        "more bring light, never less noise; fewer save time",
        "too small, rooms become darker and glass black",
        properties=("path.pathdepth.total",),
    ),
    "roulette": NoiseSetting(
        "path.russianroulette.cap",
        "higher, fewer long paths are ended at random",
        "time per sample, no light",
        properties=("path.russianroulette.cap",),
    ),
}

_MITSUBA = {
    "samples": NoiseSetting("sample_count", "averages more paths", _USUAL),
    "weight": NoiseSetting(
        "sampling_weight of an emitter",
        "draws this emitter more often than the others",
        "no light; the other emitters become noisier",
    ),
    "guided": NoiseSetting(
        "the integrator guided",
        "draws directions towards light that earlier paths have found",
        "time to train, no light; chdstat render has it, not Mitsuba alone",
    ),
    "ptracer": NoiseSetting(
        "the integrator ptracer",
        "draws paths from the emitters, which finds caustics",
        "mirrors and glass seen by the camera stay black; its samples are not those of pixels",
    ),
    "media": NoiseSetting(
        "the integrator volpathmis",
        "draws coloured media well",
        "time per sample, no light",
    ),
    "thin": NoiseSetting(
        "a mask in place of the pane, with the integrator volpath",
        "lets emitters shine through as if there were no glass",
        "the look: no reflection or refraction",
    ),
    "roulette": NoiseSetting(
        "rr_depth",
        "larger, long paths are ended at random later",
        "time per sample, no light",
    ),
    "depth": NoiseSetting(
        "max_depth",
        "more bring light, never less noise; fewer save time",
        "too small, rooms become darker and glass black",
    ),
}

SETTINGS: Mapping[str, Mapping[str, NoiseSetting]] = {
    "Cycles": _CYCLES,
    "LuxCore": _LUXCORE,
    "Mitsuba": _MITSUBA,
}
"""Settings of each renderer, by the names that `CURES` has for them."""

_AT_RATE = "four times as many halve the noise"

CURES: Mapping[str, Mapping[str, str]] = {
    "Cycles": {
        "null_heavy": "help paths to find the light: with many lamps {light_tree}, in windows lit "
        "by the world {portal}, for light round corners {guiding}, behind glass a larger {size}; "
        "clamping does not help",
        "long_tail": "find the bright paths more often: through curved glass {shadow_caustics}, "
        "round corners {guiding}, of a sun in the world image {world}; {clamping} and caustics "
        "switched off hide them, and the image becomes darker by the light they carry",
        "firefly_dominated": "more samples first: if others are as bright, see long tail; if none "
        "is, {clamping} or {filter_glossy} remove it, and light with it",
        "bimodal": "{samples}: " + _AT_RATE + "; where the lit half is a lamp's reflection, see "
        "that {multiple} is on",
        "multimodal": "with several lamps {light_tree}; then {samples}: " + _AT_RATE,
        "gamma_like": "{samples}: " + _AT_RATE + "; {threshold} spends them where they are needed; "
        "{denoise} works well here",
        "lognormal_like": "{samples}: " + _AT_RATE + "; for bounced light {guiding}; more bounces "
        "do not help",
        "other": "{samples}: " + _AT_RATE + "; with many lamps {light_tree}",
        "constant": "samples that find light are equal; where none is null, {threshold} stops "
        "early; null samples are all the noise there is, as in null-heavy pixels",
        "black": "compare it with its neighbours: if they are lit, more samples; black glass needs "
        "more {bounces}",
    },
    "LuxCore": {
        "null_heavy": "help paths to find the light: with many lights {strategy} DLS_CACHE, for "
        "sky through windows {window}, behind panes {glass}; clamping does not help here",
        "long_tail": "find the bright paths more often: for caustics {hybrid}, or {photons}, which "
        "blurs them; {clamping} hides them, and the image becomes darker by the light they carry",
        "firefly_dominated": "more samples first: if others are as bright, see long tail; if none "
        "is, {clamping} removes it, and light with it",
        "bimodal": "{samples}: " + _AT_RATE + "; a light that makes one of the two gets more "
        "samples by {importance}",
        "multimodal": "with several lights {strategy} DLS_CACHE or {importance}; then {samples}: "
        + _AT_RATE,
        "gamma_like": "{samples}: " + _AT_RATE,
        "lognormal_like": "{samples}: " + _AT_RATE + "; {cache} takes bounced light from a cache, "
        "which blurs it; a higher path depth does not help",
        "other": "{samples}: " + _AT_RATE + "; {roulette} if long paths matter",
        "black": "compare it with its neighbours: if they are lit, more samples; black glass needs "
        "more {depth}",
    },
    "Mitsuba": {
        "null_heavy": "help paths to find the light: more {weight} for the one that matters, for "
        "light round corners {guided}, behind panes {thin}",
        "long_tail": "find the bright paths more often: {guided}; for caustics of small lights "
        "{ptracer}; until then, trust no error bar of so many samples; the default estimate may be "
        "closer than the mean",
        "firefly_dominated": "draw more samples of the pixel: if others are as bright, its tail is "
        "long; if none is, it had bad luck, and estimates that look at its neighbours may help",
        "bimodal": "{samples}: " + _AT_RATE + "; an emitter that makes one of the two gets more "
        "samples by {weight}",
        "multimodal": "more {weight} for the one that makes most of the variance; then {samples}: "
        + _AT_RATE,
        "gamma_like": "{samples}: " + _AT_RATE,
        "lognormal_like": "{samples}: " + _AT_RATE + "; {guided} for bounced light, a larger "
        "{roulette} for long paths; a larger max_depth does not help",
        "other": "{samples}: " + _AT_RATE + "; in coloured media {media}",
        "black": "compare it with its neighbours: if they are lit, render it alone with more "
        "samples; black glass needs more {depth}",
    },
}
"""What helps against each pattern, by renderer; too few samples have the cure of all renderers."""


def renderer_of(attrs: Mapping[str, Any]) -> str:
    """Return the name in `CURES` of the renderer that drew samples; "" if it has none.

    Examples
    --------
    >>> renderer_of({"renderer": "Cycles 5.0.1"}), renderer_of({"mitsuba_version": "3.8.0"})
    ('Cycles', 'Mitsuba')
    >>> renderer_of({"renderer": "mine 1.2"})
    ''
    """
    said = str(attrs.get("renderer") or ("Mitsuba" if "mitsuba_version" in attrs else ""))
    words = said.lower().split()
    return next((name for name in CURES if words[:1] == [name.lower()]), "")


def cure_in(renderer: str, pattern: str, otherwise: str = "") -> str:
    """Return what helps against a pattern, in the words of a renderer of `CURES`.

    Examples
    --------
    >>> cure_in("LuxCore", "gamma_like")
    'batch.haltspp: four times as many halve the noise'
    >>> cure_in("mine", "gamma_like", "more samples")
    'more samples'
    """
    text = CURES.get(renderer, {}).get(pattern)
    return otherwise if text is None else text.format(**SETTINGS[renderer])
