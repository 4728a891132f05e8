"""Faults that developers of path tracers make, as integrators of Mitsuba: a plugin of chdstat.

``faulty`` is a path tracer like Mitsuba's ``path``: next-event estimation and sampling of the BSDF,
combined by the power heuristic, and Russian roulette from a depth on. Its ``fault`` is one of
`benchmarks.renderer_bugs.INTEGRATOR`, or "" for none: its images then have the mean of ``path``.
``moved`` moves the camera rays of the integrator ``inside``: one of
`benchmarks.renderer_bugs.CAMERA`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

if mi.variant() is None:  # imported, not loaded as a plugin
    mi.set_variant("scalar_rgb")


def _power(a, b):
    return dr.detach(dr.select(a > 0, dr.square(a) / (dr.square(a) + dr.square(b)), 0))


def _balance(a, b):
    return dr.detach(dr.select(a > 0, a / (a + b), 0))


class Faulty(mi.SamplingIntegrator):
    """A path tracer with one fault."""

    def __init__(self, props):
        super().__init__(props)
        self.fault = props.get("fault", "")
        self.longest = props.get("max_depth", 6)
        early = self.fault == "early roulette without weight"
        self.roulette = 2 if early else props.get("rr_depth", 5)

    def _numbers(self, u):
        """Return random numbers as a faulty generator draws them."""
        if self.fault == "random numbers of 6 bits":
            return dr.floor(u * 64) / 64
        return u * 0.99 if self.fault == "random numbers end at .99" else u

    def _mis(self, a, b, *, of_light):
        """Return the weight of a strategy with density a, of a sample that another draws with b."""
        if self.fault == "no MIS weights":
            return mi.Float(1)
        if self.fault == "MIS by the wrong pdf":
            return _power(a, 1 / (2 * dr.pi))  # of uniform sampling, whatever the other is
        if self.fault == "MIS of two heuristics" and of_light:
            return _balance(a, b)
        return _power(a, b)

    def _visible(self, scene, si, ds, active):
        ray = si.spawn_ray_to(ds.p)
        if self.fault == "shadow rays start late":
            ray = mi.Ray3f(ray, ray)
            ray.o = dr.fma(ray.d, 0.2 * ray.maxt, ray.o)
            ray.maxt *= 0.8
        elif self.fault == "shadow rays end early":
            ray.maxt *= 0.8
        return ~scene.ray_test(ray, active)

    def _light(self, scene, si, u, active):
        """Return a sample of direct light and its weight."""
        fault = self.fault
        by_hand = fault in ("shadow rays start late", "shadow rays end early")
        tested = not by_hand and fault != "no visibility"
        ds, weight = scene.sample_emitter_direction(si, u, tested, active)
        if by_hand:
            weight = dr.select(self._visible(scene, si, ds, active & (ds.pdf != 0)), weight, 0)
        if fault.startswith("lights "):
            _, inverse, _ = scene.sample_emitter(u.x, active)
            if fault == "lights not divided by their probability":
                weight /= inverse
            elif fault == "lights as if equally likely":
                weight *= len(scene.emitters()) / inverse
        if fault == "no cosine at the light":
            cosine = dr.abs(dr.dot(ds.d, ds.n))
            weight /= dr.select(cosine > 0, cosine, 1)
        if fault == "no sine in the environment":
            outside = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            sine = dr.sqrt(dr.maximum(1 - dr.square(ds.d.y), 1e-6))
            weight *= dr.select(outside, sine, 1)
        return ds, weight

    def _evaluated(self, value, cosine):
        """Return a value of the BSDF times the cosine, for next event."""
        cosine = dr.maximum(dr.abs(cosine), 1e-4)
        if self.fault in ("no cosine", "no cosine at next event"):
            return value / cosine
        if self.fault == "cosine twice":
            return value * cosine
        return value * dr.pi if self.fault == "no 1/pi at next event" else value

    def _bounced(self, weight, bs):
        """Return the weight of a sampled direction."""
        cosine = dr.maximum(dr.abs(mi.Frame3f.cos_theta(bs.wo)), 1e-4)
        smooth = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        if self.fault == "no cosine":
            return dr.select(smooth, weight / cosine, weight)
        if self.fault == "cosine twice":
            return dr.select(smooth, weight * cosine, weight)
        if self.fault == "uniform pdf":
            return dr.select(smooth, weight * bs.pdf * (2 * dr.pi), weight)
        glossy = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Glossy)
        if self.fault == "glossy lobe -10 %":
            return dr.select(glossy, weight * 0.9, weight)
        return dr.square(weight) if self.fault == "throughput twice" else weight

    def _roulette(self, likely):
        """Return the weight of a path that goes on."""
        if "without weight" in self.fault:
            return mi.Float(1)
        return 1 / (dr.square(likely) if self.fault == "roulette weight squared" else likely)

    def _seen(self, depth):
        """Return what the emission of what a path hits is multiplied by."""
        factor = {"emission twice at the camera": 2, "lights invisible": 0}.get(self.fault, 1)
        return dr.select(depth == 0, mi.Float(factor), 1)

    @dr.syntax
    def sample(self, scene, sampler, ray, medium=None, active=True):
        fault, context = self.fault, mi.BSDFContext()
        ray, active = mi.Ray3f(ray), mi.Bool(active)
        light, throughput = mi.Spectrum(0), mi.Spectrum(1)
        scale, depth, valid = mi.Float(1), mi.UInt32(0), mi.Bool(False)
        before = dr.zeros(mi.Interaction3f)
        pdf, delta = mi.Float(1), mi.Bool(True)
        first1, first2 = mi.Float(0), mi.Point2f(0)

        while active:
            si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
            if fault == "geometric normals":
                si.sh_frame = mi.Frame3f(si.n)
                si.wi = dr.select(si.is_valid(), si.to_local(-ray.d), si.wi)

            emitter = si.emitter(scene)
            lit = emitter != None  # noqa: E711 - of each lane
            hit = mi.DirectionSample3f(scene, si, before)
            of_light = scene.pdf_emitter_direction(before, hit, ~delta & lit)
            weight = self._mis(pdf, of_light, of_light=False)
            weight = dr.select(delta, 1, weight) * self._seen(depth)
            light += dr.select(lit, throughput * emitter.eval(si, active) * weight, 0)

            goes_on = active & si.is_valid() & (depth + 1 < self.longest)
            bsdf = si.bsdf()
            next_event = goes_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            u = self._numbers(sampler.next_2d(next_event))
            ds, em_weight = self._light(scene, si, u, next_event)
            next_event &= ds.pdf != 0
            wo = si.to_local(ds.d)
            value, bsdf_pdf = bsdf.eval_pdf(context, si, wo, next_event)
            value = self._evaluated(value, mi.Frame3f.cos_theta(wo))
            em_mis = dr.select(ds.delta, 1, self._mis(ds.pdf, bsdf_pdf, of_light=True))
            direct = dr.select(next_event, value * em_weight * em_mis, 0)
            if fault == "next event twice":
                direct *= 2
            if fault == "shadow acne":
                direct = dr.select(sampler.next_1d(next_event) < 0.03, 0, direct)

            one, two = sampler.next_1d(goes_on), sampler.next_2d(goes_on)
            if fault == "same numbers at each bounce":
                first1 = dr.select(depth == 0, one, first1)
                first2 = dr.select(depth == 0, two, first2)
                one, two = mi.Float(first1), mi.Point2f(first2)
            bs, bounced = bsdf.sample(context, si, self._numbers(one), self._numbers(two), goes_on)
            bounced = self._bounced(bounced, bs)
            if fault == "next event after the bounce":
                light += throughput * bounced * direct
            else:
                light += throughput * direct

            ray = si.spawn_ray(si.to_world(bs.wo))
            throughput *= dr.select(goes_on, bounced, 1)
            scale *= dr.select(goes_on, bs.eta, 1)
            valid |= active & si.is_valid()
            before = mi.Interaction3f(si)
            pdf = mi.Float(bs.pdf)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            depth += dr.select(si.is_valid(), mi.UInt32(1), 0)

            most = dr.max(throughput)
            likely = dr.minimum(most * dr.square(scale), 0.95)
            played = depth >= self.roulette
            survives = sampler.next_1d(goes_on) < likely
            throughput *= dr.select(played, self._roulette(likely), 1)
            active = goes_on & (~played | survives) & (most != 0)

        return light, valid, []


class Moved(mi.SamplingIntegrator):
    """An integrator whose camera rays are moved."""

    def __init__(self, props):
        super().__init__(props)
        self.fault = props.get("fault", "")
        self.inside = mi.load_dict(
            {"type": props.get("inside", "path"), "max_depth": props.get("max_depth", 6)}
        )

    def _ray(self, scene, sampler, ray):
        sensor = scene.sensors()[0]
        to_world = sensor.world_transform()
        back = to_world.inverse()
        origin, d = back @ ray.o, back @ ray.d
        ray = mi.RayDifferential3f(ray)
        ray.has_differentials = False
        if self.fault == "lens":  # a radius that is uniform, not its square
            distance = mi.traverse(sensor)["focus_distance"]
            radius = mi.traverse(sensor)["aperture_radius"]
            focus = origin + d * (distance / d.z)
            origin = origin * (dr.norm(mi.Vector2f(origin.x, origin.y)) / radius)
            d = focus - origin
            ray.o = to_world @ mi.Point3f(origin)
        else:
            edge = 2 * dr.tan(dr.deg2rad(mi.traverse(sensor)["x_fov"]) / 2) / self.pixels
            x, y = d.x / d.z / edge, d.y / d.z / edge
            if self.fault == "tent":
                u = sampler.next_2d()
                x, y = x + u.x - 0.5, y + u.y - 0.5
            else:
                x, y = dr.floor(x) + 0.5, dr.floor(y) + 0.5
            d = mi.Vector3f(x * edge, y * edge, 1)
        ray.d = dr.normalize(to_world @ mi.Vector3f(d))
        return ray

    def sample(self, scene, sampler, ray, medium=None, active=True):
        return self.inside.sample(scene, sampler, self._ray(scene, sampler, ray), medium, active)


def _moved(props):
    pixels = props.get("pixels", 64)
    made = Moved(props)
    made.pixels = pixels
    return made


mi.register_integrator("faulty", lambda props: Faulty(props))
mi.register_integrator("moved", _moved)
