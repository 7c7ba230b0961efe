"""The formation study: its exact model, its bound, its parts on few runs, and what a run leaves behind."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import cramer_rao_oracle as oracle

from torchfilt import Gaussian, StateSpaceModel, UnscentedKalmanFilter
from torchfilt.missions.bound import cramer_rao_bound
from torchfilt.missions.formation import (
    FILTERS,
    StudySettings,
    leakage,
    lost_runs,
    make_filter,
    make_scene,
    run_filter,
    run_formation,
    run_rmse,
    scene_bound,
    summarize,
    table,
    train_gp,
)
from torchfilt.missions.stages import Stages
from torchfilt.models.relative_motion import (
    FormationSettings,
    RendezvousRadar,
    chief_controls,
    propagate_formation,
    simulate_formation,
    training_pairs,
)
from torchfilt.models.relative_motion.high_fidelity import ExactFormation, perturbation
from torchfilt.models.relative_motion.truth import perturbation as numpy_perturbation

SHORT = StudySettings(runs=4, steps=130, samples=120, particles=20, bootstrap_particles=200)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SHORT)


@pytest.fixture(scope="module")
def trained():
    return train_gp(SHORT)


@pytest.fixture(scope="module")
def gp(trained):
    return trained[0]


class TestExactModel:
    def test_it_is_the_integrated_truth_on_two_revolutions(self):
        formation = FormationSettings()
        x, u, x_next = training_pairs(formation, "cloud", 100, seed=3, span_s=(0, 2 * formation.period_s))
        one, two = (ExactFormation(formation, steps=steps)(x, u, 10.0).mean - x_next for steps in (1, 2))
        # Fourth order: a step leaves (n dt)^5 / 120 of 1 km, 1e-9 m, and half the step a sixteenth of that.
        assert one[:, :3].abs().max() < 1e-8 and one[:, 3:].abs().max() < 1e-10
        assert 8 < one[:, :3].norm() / two[:, :3].norm() < 32

    def test_thrust_is_the_truths_own(self):
        formation = FormationSettings()
        x, u, _ = training_pairs(formation, "cloud", 20, seed=4)
        thrust = torch.tensor([3e-3, -2e-3, 1e-3], dtype=torch.float64)
        end = propagate_formation(u[:, 3:6], u[:, 6:9], x, 10.0, formation, u[:, 9:12], thrust)
        u[:, :3] = thrust
        # The thrust turns with the chief; its own motion is unchanged.
        assert (ExactFormation(formation, steps=2)(x, u, 10.0).mean - end.relative_m_m_s).abs().max() < 1e-8

    def test_forces_are_those_of_the_simulator(self):
        formation = FormationSettings()
        generator = torch.Generator().manual_seed(0)
        p = torch.randn(50, 3, generator=generator, dtype=torch.float64)
        p = 7e6 * p / torch.linalg.vector_norm(p, dim=-1, keepdim=True)
        v = 7.5e3 * torch.randn(50, 3, generator=generator, dtype=torch.float64)
        expected = torch.from_numpy(numpy_perturbation(p.numpy(), v.numpy(), 0.022, formation))
        assert (perturbation(p, v, 0.022, formation) - expected).abs().max() < 1e-15

    def test_noise_shapes_and_no_motion(self):
        formation = FormationSettings()
        x, u, _ = training_pairs(formation, "cloud", 6, seed=5)
        law = ExactFormation(formation, acceleration_psd_m2_s3=1e-9)
        still = law(x, u, torch.tensor([[0.0], [10.0]] * 3, dtype=torch.float64))
        moved = law(x, u, 10.0)
        assert torch.equal(still.mean[::2], x[::2]) and torch.allclose(still.mean[1::2], moved.mean[1::2], atol=1e-12)
        assert torch.equal(law(x, u, 0.0).mean, x)
        velocity = moved.covariance[:, 3:, 3:].diagonal(dim1=-2, dim2=-1)
        assert torch.allclose(velocity, torch.full_like(velocity, 1e-8), rtol=1e-3)
        cloud = law(x[0].expand(3, 4, 6), u[0], 10.0).mean
        assert torch.allclose(cloud, moved.mean[0].expand(3, 4, 6), atol=1e-12)

    def test_bad_arguments_are_named(self):
        with pytest.raises(ValueError, match="acceleration_psd_m2_s3 must be >= 0, got -1"):
            ExactFormation(FormationSettings(), -1.0)
        with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
            ExactFormation(FormationSettings(), steps=0)
        with pytest.raises(ValueError, match="needs the time step"):
            ExactFormation(FormationSettings())(torch.zeros(6).double(), torch.zeros(21).double())


class TestBound:
    def test_it_is_the_inverse_information_of_absolute_orbits(self):
        # A revolution under the forces that the oracle has.
        forces = FormationSettings(j3=0.0, j4=0.0, chief_area_m2=0.0, deputy_area_m2=0.0)
        time = torch.arange(584, dtype=torch.float64) * 10
        truth = simulate_formation(forces, time)
        deviation = torch.tensor([1.0] * 3 + [0.01] * 3, dtype=torch.float64)
        got = cramer_rao_bound(
            ExactFormation(forces),
            RendezvousRadar(7e6),
            torch.diag(deviation),
            truth.relative_m_m_s,
            chief_controls(truth.chief),
            10.0,
        ).numpy()
        position, velocity = (v.numpy() for v in forces.chief_start())
        noise = np.array([0.1 / 3, math.radians(0.05) / 3, math.radians(0.05) / 3])
        start = truth.relative_m_m_s[0].numpy()
        expected = oracle.bound(position, velocity, start, deviation.numpy(), noise, time[1:].numpy(), 7e6)
        scale = np.sqrt(np.einsum("tii->ti", expected))
        error = (got - expected) / (scale[:, :, None] * scale[:, None, :])
        # Finite differences keep eight digits; late bounds lean on what is known 1e4 times worse.
        assert np.abs(error).max() < 1e-6

    def test_process_noise_and_measurements_move_it_the_right_way(self, scene):
        free = scene_bound(scene)
        arguments = (scene.prior.factor(), scene.states, scene.controls, 10.0)
        noisy = cramer_rao_bound(ExactFormation(scene.formation, 1e-9), RendezvousRadar(7e6), *arguments)
        coarse = cramer_rao_bound(ExactFormation(scene.formation), RendezvousRadar(7e6, range_sd_m=10.0), *arguments)
        for worse in (noisy, coarse):
            assert (torch.linalg.eigvalsh(_scaled(worse - free, worse))[1:] > -1e-9).all()

    def test_no_filter_of_many_runs_beats_it(self):
        many = replace(SHORT, runs=400, steps=40)
        scene = make_scene(many)
        result = run_filter("exact-ukf", scene, many)
        bound = scene_bound(scene)[-1].diagonal()
        square = torch.from_numpy(result["error"][-1]).square().mean(0)
        # 400 squares of a normal: relative standard error sqrt(2 / 400) = 0.07; five of them on six coordinates
        # alarm once in 3e5. The posterior is all but normal, so the bound is reached from above.
        assert (square / bound - 1).abs().max() < 5 * math.sqrt(2 / 400)


def _scaled(difference, covariance):
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    return difference / (scale.unsqueeze(-1) * scale.unsqueeze(-2))


class TestScene:
    def test_noise_has_the_stated_size_and_runs_differ(self):
        many = replace(SHORT, runs=500, steps=20)
        scene = make_scene(many)
        radius = torch.linalg.vector_norm(scene.controls[:, 12:15], dim=-1, keepdim=True)
        clean = RendezvousRadar(radius).measure(scene.truth.unsqueeze(1))
        white = (scene.measurements - clean) / torch.tensor([0.1 / 3, *[math.radians(0.05) / 3] * 2]).double()
        start = (scene.prior.mean - scene.states[0]) / torch.tensor([1.0] * 3 + [0.01] * 3).double()
        # Mean and variance of 10,000 and of 500 normals a column; five standard errors.
        for sample in (white.flatten(0, 1), start):
            count = len(sample)
            assert sample.mean(0).abs().max() < 5 / math.sqrt(count)
            assert (sample.var(0) - 1).abs().max() < 5 * math.sqrt(2 / count)

    def test_same_seed_same_bits_and_steps_only_extend(self):
        short, long = make_scene(replace(SHORT, steps=30)), make_scene(replace(SHORT, steps=40))
        again = make_scene(replace(SHORT, steps=30))
        assert torch.equal(short.measurements, again.measurements)
        assert torch.equal(short.prior.mean, long.prior.mean)
        assert not torch.equal(short.measurements, make_scene(replace(SHORT, steps=30, seed=1)).measurements)

    def test_cases_are_what_they_say(self):
        usual, moved = make_scene(replace(SHORT, steps=30)), make_scene(replace(SHORT, steps=30, case="moved"))
        shift = moved.states[0] - usual.states[0]
        assert torch.allclose(shift[:3], torch.full((3,), 20.0).double()) and shift[4] < 0
        wide = make_scene(replace(SHORT, steps=30, case="wide"))
        assert torch.allclose(wide.prior.factor().diagonal(), torch.tensor([100.0] * 3 + [1.0] * 3).double())
        thrust = make_scene(replace(SHORT, steps=125, case="control"))
        assert (thrust.controls[:, :3].abs().sum(0) > 0).all()
        assert (usual.controls[:, :3] == 0).all()
        # Thrust moves the deputy off its path, and a filter's law that knows it stays on: no error but the law's own.
        free = make_scene(replace(SHORT, steps=125))
        assert (thrust.truth - free.truth)[-1, :3].norm() > 1
        predicted = ExactFormation(thrust.formation)(thrust.states[:-1], thrust.controls, 10.0).mean
        assert (predicted - thrust.truth).abs().max() < 1e-8

    def test_revolutions_leave_out_the_transient(self, scene):
        assert set(scene.revolutions()) == {"orbit1"}
        mask = scene.revolutions()["orbit1"]
        assert scene.time_s[mask].min() > 1000 and int(mask.sum()) == 30
        assert make_scene(replace(SHORT, steps=60)).revolutions() == {}

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"runs": 0}, "runs must be at least 1, got 0"),
            ({"case": "other"}, "case must be one of nominal, .*, got 'other'"),
            ({"gp_psd_m2_s3": -1.0}, "gp_psd_m2_s3 must be positive and finite, got -1.0"),
            ({"seed": -1}, "seed must be from 0 to 2147483647, got -1"),
        ],
    )
    def test_settings_that_make_no_sense_are_named(self, change, message):
        with pytest.raises(ValueError, match=message):
            replace(SHORT, **change)


class TestFilters:
    def test_learned_filters_follow_the_exact_one(self, scene, gp):
        exact = run_filter("exact-ukf", scene, SHORT)
        last = exact["deviation"][-1]
        for name, limit in (("gp-ukf", 0.02), ("mf-upf", 2.0)):
            result = run_filter(name, scene, SHORT, gp)
            assert result["ok"].all()
            # Same data: the GP-UKF differs by the GP alone, the particle filter by its 20 particles as well.
            assert (np.abs(result["error"][-1] - exact["error"][-1]) / last).max() < limit

    def test_control_and_particles_reach_the_filters(self, scene, gp):
        assert make_filter("mf-upf", scene, SHORT, gp).particles == 20
        assert make_filter("cw-pf", scene, SHORT).particles == 200
        paper = make_filter("cw-pf-paper-noise", scene, SHORT).model.transition
        form = paper.linear_form(scene.controls[0])
        assert torch.allclose(form.scale_tril.diagonal(), torch.tensor([0.01] * 3 + [1e-3] * 3).double())
        tuned = make_filter("cw-ukf", scene, SHORT).model.transition
        assert torch.allclose(form.matrix, tuned.matrix)
        u = torch.zeros(21).double()
        u[:3] = 1e-3
        assert torch.allclose(paper.linear_form(u).offset, tuned.linear_form(u).offset)

    def test_the_literal_form_collapses_onto_one_particle(self, scene, gp):
        result = run_filter("mf-upf-literal", scene, SHORT, gp)
        proper = run_filter("mf-upf", scene, SHORT, gp)
        assert result["error"].shape == proper["error"].shape
        rows = scene.revolutions()["orbit1"].numpy()
        assert result["ess"][rows].mean() < 1.5 < proper["ess"][rows].mean()
        ratio = run_rmse(result["error"][rows][..., :3]) / run_rmse(proper["error"][rows][..., :3])
        assert np.median(ratio) > 5

    def test_names_and_missing_gp(self, scene):
        with pytest.raises(ValueError, match=r"filter must be one of cw-pf, .*, got 'kf'"):
            make_filter("kf", scene, SHORT)
        with pytest.raises(ValueError, match="gp-ukf needs the GP that train_gp makes"):
            make_filter("gp-ukf", scene, SHORT)

    def test_training_reports_errors_on_other_draws(self, trained):
        report = trained[1]
        step = report["one_step"]
        assert step["position_m"]["rms"] < 2e-7 and step["velocity_m_s"]["rms"] < 4e-8
        assert report["roll_out_one_revolution_m"] < 1e-3


class TestNumbers:
    def test_nees_is_the_quadratic_form(self):
        settings = replace(SHORT, steps=25)
        scene = make_scene(settings)
        result = run_filter("cw-ukf", scene, settings)
        history = make_filter("cw-ukf", scene, settings)(scene.measurements, scene.controls, 10.0)
        error = torch.from_numpy(result["error"])
        expected = torch.einsum("tri,trij,trj->tr", error, torch.linalg.inv(history.covariance), error)
        assert np.allclose(result["nees"], expected, rtol=1e-6)

    def test_summary_of_known_errors(self, scene):
        shape = (SHORT.steps, SHORT.runs)
        error = np.zeros((*shape, 6))
        error[..., 0] = [1.0, 2.0, 3.0, 100.0]
        error[..., 3] = 0.5
        result = {
            "error": error,
            "nees": np.full(shape, 6.0),
            "ess": np.full(shape, np.nan),
            "ok": np.ones(shape, bool),
            "cpu_s": np.array(1.04),
        }
        entry = summarize(result, scene)["orbit1"]
        assert entry["position_rmse_m"] == 2.5 and entry["position_rmse_worst_m"] == 100
        assert entry["position_rms_all_runs_m"] == pytest.approx(math.sqrt((1 + 4 + 9 + 1e4) / 4))
        assert entry["velocity_rmse_m_s"] == 0.5 and entry["ess"] is None and entry["lost"] == 1
        assert entry["ms_per_step"] == pytest.approx(1e3 * 1.04 / (130 * 4))
        assert entry["nees"] == 6 and entry["nees_inside_band"] == 1
        error[5, 1] = np.nan
        result["ok"][5, 1] = False
        rows = np.ones(SHORT.steps, bool)
        assert lost_runs(result, rows).tolist() == [False, True, False, True]
        error[:, 1] = np.nan
        assert summarize(result, scene)["orbit1"]["position_rmse_worst_m"] is None
        json.dumps(summarize(result, scene), allow_nan=False)

    def test_leakage_is_a_paired_test(self):
        generator = np.random.default_rng(0)
        exact = {"error": generator.standard_normal((200, 10, 6)) * generator.uniform(0.5, 2, (1, 10, 1))}
        rows = np.ones(200, bool)

        def scaled(factor):
            return {"error": exact["error"] * factor}

        assert not leakage(exact, exact, rows) and not leakage(scaled(1.3), exact, rows)
        assert not leakage(scaled(0.97), exact, rows)
        assert leakage(scaled(0.9), exact, rows)
        # Half the runs much better and half worse is chance.
        mixed = scaled(np.where(np.arange(10) % 2, 0.5, 1.5)[None, :, None])
        assert not leakage(mixed, exact, rows)
        # Velocities alone give it away too.
        assert leakage(scaled(np.array([1, 1, 1, 0.7, 0.7, 0.7])), exact, rows)


class TestStages:
    def test_a_stage_is_computed_once_for_each_recipe(self, tmp_path):
        made, said = [], []
        stages = Stages(tmp_path, said.append)

        def compute():
            made.append(1)
            return {"a": np.arange(3.0), "b": np.array(True)}

        for _ in range(2):
            got = stages.get("x", {"k": 1}, compute)
            assert got["a"].tolist() == [0, 1, 2] and bool(got["b"])
        stages.get("x", {"k": 2}, compute)
        stages.get("y", {"k": 1}, compute)
        assert len(made) == 3 and said == []
        Stages(None).get("x", {"k": 1}, compute)
        assert len(made) == 4

    def test_a_flipped_byte_is_found_and_the_stage_made_again(self, tmp_path):
        said = []
        stages = Stages(tmp_path, said.append)
        stages.get("x", {}, lambda: {"a": np.zeros(100)})
        path = stages.path("x", {})
        data = bytearray(path.read_bytes())
        data[50] ^= 1
        path.write_bytes(data)
        assert stages.get("x", {}, lambda: {"a": np.ones(1)})["a"].tolist() == [1]
        assert len(said) == 1 and "SHA-256" in said[0]
        stages.clear()
        assert not list(tmp_path.iterdir())


class TestRun:
    NAMES = ("cw-ukf", "gp-ukf", "mf-upf", "exact-ukf")

    def test_a_run_leaves_numbers_figures_and_stages_and_resumes(self, tmp_path):
        said = []
        summary = run_formation(SHORT, tmp_path, self.NAMES, say=said.append)
        stored = json.loads((tmp_path / "metrics.json").read_text())
        assert stored == json.loads(json.dumps(summary))
        assert set(stored["paper"]) == set(self.NAMES) and stored["seeds"] == [0, 0]
        wanted = {"position_rmse_m", "velocity_rmse_m_s", "nees", "ess", "ms_per_step"}
        for entries in stored["paper"].values():
            assert wanted <= set(entries["orbit1"])
        assert stored["paper"]["mf-upf"]["orbit1"]["ess"] > 5
        assert {"position_rmse_m", "velocity_rmse_m_s"} <= set(stored["bound"]["orbit1"])
        assert stored["leakage"] == {"gp-ukf": False, "mf-upf": False}
        pictures = {path.name for path in (tmp_path / "figures").glob("*.png")}
        assert pictures == {"path.png", "errors.png", *(f"error-{name}.png" for name in self.NAMES)}
        assert any("Cramér-Rao bound" in line for line in said)
        for name in self.NAMES:
            assert any(line.startswith(name) for line in table(summary))
        said.clear()
        again = run_formation(SHORT, tmp_path, self.NAMES, say=said.append, figures=False)
        assert again == summary
        assert sum("as before" in line for line in said) == len(self.NAMES) + 1

    def test_what_a_filter_does_not_use_does_not_spoil_its_stage(self, tmp_path):
        settings = replace(SHORT, steps=30, runs=2)
        run_formation(settings, tmp_path, ["cw-ukf", "exact-ukf"], say=lambda line: None, figures=False)
        said = []
        other = replace(settings, particles=50, cw_psd_m2_s3=1e-9)
        run_formation(other, tmp_path, ["cw-ukf", "exact-ukf"], say=said.append, figures=False)
        assert [line.split()[0] for line in said if "as before" in line] == ["exact-ukf"]

    def test_an_asked_stop_ends_between_stages_and_writes_no_metrics(self, tmp_path):
        answers = iter([False, True])
        settings = replace(SHORT, steps=30, runs=2)
        summary = run_formation(
            settings, tmp_path, ["cw-ukf", "exact-ukf"], say=lambda line: None, stop=lambda: next(answers)
        )
        assert summary["interrupted"] and list(summary["paper"]) == ["cw-ukf"]
        assert not (tmp_path / "metrics.json").exists()
        assert len(list((tmp_path / "stages").glob("*.npz"))) == 1

    def test_unknown_filters_are_named(self, tmp_path):
        with pytest.raises(ValueError, match=f"out of {FILTERS[0]}, .*, got ekf"):
            run_formation(SHORT, tmp_path, ["ekf"])


def test_a_prior_of_each_run_and_one_for_all_give_the_same(scene):
    one = scene.prior.mean[0]
    model = StateSpaceModel(
        Gaussian(one, scene.prior.factor()),
        ExactFormation(scene.formation),
        RendezvousRadar(scene.formation.semi_major_axis_m),
    )
    alone = UnscentedKalmanFilter(model)(scene.measurements[:20, 0], scene.controls[:20], 10.0).mean
    batch = make_filter("exact-ukf", scene, SHORT)(scene.measurements[:20], scene.controls[:20], 10.0).mean
    assert torch.allclose(alone, batch[:, 0], atol=1e-9)
