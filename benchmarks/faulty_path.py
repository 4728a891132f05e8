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
    """A path tracer with one fault, or with several that leave its paths as they are.

    Attributes
    ----------
    faults
        Names of the faults. The light of each is summed up along the same paths.
    """

    def __init__(self, props):
        super().__init__(props)
        self.faults = (props.get("fault", ""),)
        self.longest = props.get("max_depth", 6)
        early = self.faults == ("early roulette without weight",)
        self.roulette = 2 if early else props.get("rr_depth", 5)

    # --- faults of paths: only of a single fault ------------------------------------------------

    def _numbers(self, u):
        """Return random numbers as a faulty generator draws them."""
        if self.faults[0] == "random numbers of 6 bits":
            return dr.floor(u * 64) / 64
        return u * 0.99 if self.faults[0] == "random numbers end at .99" else u

    def _bounced(self, weight, bs):
        """Return the weight of a sampled direction."""
        fault = self.faults[0]
        cosine = dr.maximum(dr.abs(mi.Frame3f.cos_theta(bs.wo)), 1e-4)
        smooth = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        if fault == "no cosine":
            return dr.select(smooth, weight / cosine, weight)
        if fault == "cosine twice":
            return dr.select(smooth, weight * cosine, weight)
        if fault == "uniform pdf":
            return dr.select(smooth, weight * bs.pdf * (2 * dr.pi), weight)
        glossy = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Glossy)
        if fault == "glossy lobe -10 %":
            return dr.select(glossy, weight * 0.9, weight)
        return dr.square(weight) if fault == "throughput twice" else weight

    def _roulette(self, likely):
        """Return the weight of a path that goes on."""
        if "without weight" in self.faults[0]:
            return mi.Float(1)
        return 1 / (dr.square(likely) if self.faults[0] == "roulette weight squared" else likely)

    # --- faults of light: of several ------------------------------------------------------------

    def _mis(self, fault, a, b, *, of_light):
        """Return the weight of a strategy with density a, of a sample that another draws with b."""
        if fault == "no MIS weights":
            return mi.Float(1)
        if fault == "MIS by the wrong pdf":
            return _power(a, 1 / (2 * dr.pi))  # of uniform sampling, whatever the other is
        if fault == "MIS of two heuristics" and of_light:
            return _balance(a, b)
        return _power(a, b)

    def _counts(self, fault, depth):
        """Return whether light of such a depth counts."""
        less = int(fault.split()[1]) if fault.startswith("depth ") else 0
        return depth < self.longest - less

    def _seen(self, fault, depth):
        """Return what the emission of what a path hits is multiplied by."""
        factor = {"emission twice at the camera": 2, "lights invisible": 0}.get(fault, 1)
        return dr.select(depth == 0, mi.Float(factor), 1)

    def _visible(self, fault, scene, si, ds, active):
        """Return whether a sample of light is seen."""
        ray = mi.Ray3f(si.spawn_ray_to(ds.p))
        if fault == "shadow rays start late":
            ray.o = dr.fma(ray.d, 0.2 * ray.maxt, ray.o)
            ray.maxt *= 0.8
        elif fault == "shadow rays end early":
            ray.maxt *= 0.8
        return ~scene.ray_test(ray, active)

    def _light(self, fault, scene, u, ds, active):
        """Return what a sample of light is multiplied by."""
        if fault == "next event twice":
            return mi.Float(2)
        if fault.startswith("lights "):
            _, inverse, _ = scene.sample_emitter(u.x, active)
            if fault == "lights not divided by their probability":
                return 1 / inverse
            if fault == "lights as if equally likely":
                return len(scene.emitters()) / inverse
        if fault == "no cosine at the light":
            cosine = dr.abs(dr.dot(ds.d, ds.n))
            return 1 / dr.select(cosine > 0, cosine, 1)
        if fault == "no sine in the environment":
            outside = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            sine = dr.sqrt(dr.maximum(1 - dr.square(ds.d.y), 1e-6))
            return dr.select(outside, sine, 1)
        return mi.Float(1)

    def _evaluated(self, fault, value, cosine):
        """Return a value of the BSDF times the cosine, for next event."""
        cosine = dr.maximum(dr.abs(cosine), 1e-4)
        if fault in ("no cosine", "no cosine at next event"):
            return value / cosine
        if fault == "cosine twice":
            return value * cosine
        return value * dr.pi if fault == "no 1/pi at next event" else value

    def _hit(self, si, lit, emitted, densities, delta, depth):
        """Return the emission of what a path hits, for each fault."""
        found = []
        for fault in self.faults:
            weight = dr.select(delta, 1, self._mis(fault, *densities, of_light=False))
            here = lit & self._counts(fault, depth)
            found.append(dr.select(here, emitted * weight * self._seen(fault, depth), 0))
        return found

    def _next_event(self, scene, sampler, si, bsdf, depth, active):
        """Return the light that is sampled, for each fault."""
        u, acne = self._numbers(sampler.next_2d(active)), sampler.next_1d(active)
        ds, weight = scene.sample_emitter_direction(si, u, False, active)
        active &= ds.pdf != 0
        wo = si.to_local(ds.d)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
        visible, found = self._visible("", scene, si, ds, active), []
        for fault in self.faults:
            seen = visible
            if fault.startswith("shadow rays"):
                seen = self._visible(fault, scene, si, ds, active)
            elif fault == "no visibility":
                seen = mi.Bool(True)
            elif fault == "shadow acne":
                seen = visible & (acne >= 0.03)
            light = self._evaluated(fault, value, mi.Frame3f.cos_theta(wo)) * weight
            light *= dr.select(ds.delta, 1, self._mis(fault, ds.pdf, pdf, of_light=True))
            light *= self._light(fault, scene, u, ds, active)
            here = active & seen & self._counts(fault, depth + 1)
            found.append(dr.select(here, light, 0))
        return found

    def _black(self):
        return [mi.Spectrum(0) for _ in self.faults]

    def _sums(self, lights, hit, direct, throughput, bounced):
        """Return the light of each fault with what a segment adds."""
        later = [throughput * (bounced if "after the" in fault else 1) for fault in self.faults]
        every = zip(lights, hit, later, direct, strict=True)
        return [light + seen + weight * one for light, seen, weight, one in every]

    # --- paths ----------------------------------------------------------------------------------

    @dr.syntax
    def lights(self, scene, sampler, ray, active=True):
        """Return the light of each fault, and whether rays hit something."""
        ray, active = mi.Ray3f(ray), mi.Bool(active)
        lights, throughput = self._black(), mi.Spectrum(1)
        scale, depth, valid = mi.Float(1), mi.UInt32(0), mi.Bool(False)
        before = dr.zeros(mi.Interaction3f)
        pdf, delta = mi.Float(1), mi.Bool(True)
        first1, first2 = mi.Float(0), mi.Point2f(0)

        while active:
            si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
            if self.faults[0] == "geometric normals":
                si.sh_frame = mi.Frame3f(si.n)
                si.wi = dr.select(si.is_valid(), si.to_local(-ray.d), si.wi)

            emitter = si.emitter(scene)
            lit = emitter != None  # noqa: E711 - of each lane
            there = mi.DirectionSample3f(scene, si, before)
            of_light = scene.pdf_emitter_direction(before, there, ~delta & lit)
            emitted = throughput * emitter.eval(si, active)
            hit = self._hit(si, active & lit, emitted, (pdf, of_light), delta, depth)

            goes_on = active & si.is_valid() & (depth + 1 < self.longest)
            bsdf = si.bsdf()
            smooth = goes_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            direct = self._next_event(scene, sampler, si, bsdf, depth, smooth)

            one, two = sampler.next_1d(goes_on), sampler.next_2d(goes_on)
            if self.faults[0] == "same numbers at each bounce":
                first1 = dr.select(depth == 0, one, first1)
                first2 = dr.select(depth == 0, two, first2)
                one, two = mi.Float(first1), mi.Point2f(first2)
            context = mi.BSDFContext()
            bs, bounced = bsdf.sample(context, si, self._numbers(one), self._numbers(two), goes_on)
            bounced = dr.select(goes_on, self._bounced(bounced, bs), 1)
            lights = self._sums(lights, hit, direct, throughput, bounced)

            ray = si.spawn_ray(si.to_world(bs.wo))
            throughput *= bounced
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

        return lights, valid

    def sample(self, scene, sampler, ray, medium=None, active=True):
        (light, *_), valid = self.lights(scene, sampler, ray, active)
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
