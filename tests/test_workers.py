"""Simulations in processes of their own: the same to the bit, in order, and what fails says so."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from typing import Any

import numpy as np
import pytest
import torch
from flight import OMEGA, VELOCITY, observed, scene, small_simulation
from linear_model import LinearModel, baseline
from small import SMALL

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.errors import InputError, MasivError
from masiv.identification.classical.fit import FamilyFit
from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.objective import Objective
from masiv.identification.neural.starting_law import choose_starting_laws, search_cost
from masiv.inference.model_fit import ModelResidual
from masiv.models.base import Model
from masiv.models.families import FAMILIES
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState
from masiv.observations.motion import SampledMotion
from masiv.refinement.baselines import ALL_FRAMES_STAGE, baselines, differentiated
from masiv.refinement.hypotheses import Linearizations, linearized, nearly_linearized, weighed
from masiv.refinement.tasks import map_tasks, rank
from masiv.workers import TaskError, Workers, process_count, unwrap, workers_for

pytestmark = pytest.mark.usefixtures("taichi")


@pytest.fixture(scope="module")
def two():
    with Workers(2) as workers:
        yield workers


def halved(number):
    if number % 2:
        raise MasivError(f"{number} is odd")
    return number // 2, os.getpid()


def blamed():
    raise InputError("no such effect")


def dies():
    os._exit(1)


def threads():
    return runtime.threads(), os.environ["OMP_NUM_THREADS"]


def raised_by_one(tensor):
    tensor += 1.0
    return tensor


class CountsPickles:
    """Counts how often it is pickled in this process."""

    pickles = 0

    def __init__(self, value):
        self.value = value

    def __reduce__(self):
        CountsPickles.pickles += 1
        return CountsPickles, (self.value,)


def changed(shared, step):
    """What it is given, changed by this task only."""
    shared.value += step
    return shared.value


def writes_late(folder):
    (folder / f"started {os.getpid()}").touch()
    time.sleep(30)
    (folder / f"finished {os.getpid()}").touch()


PUTENV = []
"""Names of environment variables that this process sets while a test listens."""


def _listen(event, arguments):
    if event == "os.putenv" and PUTENV:
        PUTENV.append(os.fsdecode(arguments[0]))


sys.addaudithook(_listen)


def quiet(*_):
    pass


class Listening(Workers):
    """heard: the tasks of each ``map``."""

    def __init__(self):
        super().__init__(1)
        self.heard = []

    def map(self, function, tasks, *, shared=()):
        self.heard.append(list(tasks))
        return super().map(function, self.heard[-1], shared=shared)


@pytest.mark.slow
def test_a_tensor_is_copied_to_a_process_and_its_memory_stays_where_it_is(two):
    """A simulation beside may be reading it."""
    given = torch.zeros(3)
    place = given.data_ptr()
    results = [*two.map(raised_by_one, [(given,), (given,)]), two.submit(raised_by_one, (given,))()]
    assert [r.tolist() for r in results] == [[1.0] * 3] * 3
    assert given.tolist() == [0.0] * 3
    assert given.data_ptr() == place
    assert not given.is_shared()
    assert not any(r.is_shared() for r in results)


def test_results_come_in_order_and_a_failure_is_one_of_them(two):
    found = list(two.map(halved, [(k,) for k in range(10)]))
    assert [f[0] for f in found[::2]] == [0, 1, 2, 3, 4]
    assert [f.reason for f in found[1::2]] == [f"{k} is odd" for k in (1, 3, 5, 7, 9)]
    assert os.getpid() not in {f[1] for f in found[::2]}
    assert [isinstance(f, TaskError) for f in Workers(1).map(halved, [(1,), (3,)])] == [True, True]


def test_bad_input_stays_bad_input(two):
    results = list(two.map(blamed, [(), ()]))
    assert len(results) == 2
    for found in results:
        with pytest.raises(InputError, match="no such effect"):
            unwrap(found)


def test_each_process_runs_on_one_thread_and_this_one_as_before(two):
    before = dict(os.environ)
    assert set(two.map(threads, [()] * 4)) == {(1, "1")}
    assert dict(os.environ) == before


@pytest.mark.slow
def test_the_environment_of_this_process_is_never_changed():
    """Not even for a moment: another thread may read it, or start a process of its own."""
    PUTENV.append("listening")
    try:
        with Workers(2) as workers:
            assert set(workers.map(threads, [()] * 2)) == {(1, "1")}
        assert PUTENV == ["listening"]
    finally:
        PUTENV.clear()


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_shared_arguments_are_pickled_once(processes):
    with Workers(processes) as workers:
        CountsPickles.pickles = 0
        shared = CountsPickles(10)
        found = list(workers.map(changed, [(k,) for k in range(6)], shared=(shared,)))
        assert CountsPickles.pickles == (1 if processes > 1 else 0)
        if processes > 1:  # each task has a copy of its own
            assert found == [10, 11, 12, 13, 14, 15]
            assert shared.value == 10


@pytest.fixture(scope="module")
def cluster():
    """A scheduler with two workers of one thread each."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster


@pytest.mark.slow
def test_workers_of_a_dask_scheduler_are_as_processes(cluster):
    with workers_for(0, cluster.scheduler_address) as workers:
        assert workers.processes == 2
        CountsPickles.pickles = 0
        shared = CountsPickles(10)
        assert list(workers.map(changed, [(k,) for k in range(6)], shared=(shared,))) == [10, 11, 12, 13, 14, 15]
        assert CountsPickles.pickles == 1
        assert set(workers.map(threads, [()] * 4)) == {(1, "1")}
        found = list(workers.map(halved, [(k,) for k in range(4)]))
        assert [f[0] for f in found[::2]] == [0, 1]
        assert found[1].reason == "1 is odd"
        assert os.getpid() not in {f[1] for f in found[::2]}
        with pytest.raises(InputError, match="no such effect"):
            unwrap(workers.submit(blamed, ())())


@pytest.mark.slow
def test_a_scheduler_that_cannot_be_used_is_bad_input():
    distributed = pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        workers_for(0, "tcp://127.0.0.1:1")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=":0") as wide,
        pytest.raises(InputError, match="has a worker of 2 threads: start some with dask worker"),
    ):
        workers_for(0, wide.scheduler_address)


@pytest.mark.slow
def test_an_error_does_not_wait_for_running_tasks(tmp_path):
    def fail():
        with Workers(2) as workers:
            for _ in range(2):
                workers.submit(writes_late, (tmp_path,))
            while len(list(tmp_path.glob("started *"))) < 2:
                time.sleep(0.05)
            raise MasivError("elsewhere")

    with pytest.raises(MasivError, match="elsewhere"):
        fail()
    assert not list(tmp_path.glob("finished *"))


@pytest.mark.slow
def test_a_process_that_dies_is_told_of():
    with Workers(2, "identify.processes") as workers, pytest.raises(MasivError, match=r"set identify\.processes to 1"):
        list(workers.map(dies, [(), ()]))


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_a_task_beside_this_process(processes):
    with Workers(processes) as workers:
        here, failing = workers.submit(os.getpid, ()), workers.submit(blamed, ())
        assert (here() == os.getpid()) == (processes == 1)
        assert isinstance(failing(), TaskError)


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_processes_begin_before_they_are_asked_for_anything(processes):
    before = len(multiprocessing.active_children())
    with Workers(processes) as workers:
        workers.start()
        assert (len(multiprocessing.active_children()) > before) == (processes > 1)


def test_as_many_as_asked_or_as_there_are_cores():
    assert process_count(3) == 3
    assert 1 <= process_count(0) <= 4


@pytest.mark.slow
def test_the_start_of_a_law_is_the_same_to_the_bit_side_by_side(two, monkeypatch):
    monkeypatch.setattr("masiv.identification.neural.starting_law.START_MODULI", (1e4, 3e4))
    monkeypatch.setattr("masiv.identification.neural.starting_law.SEARCHED_MATERIALS", 2)
    motion = observed({})
    motion = SampledMotion(motion.positions[:3], motion.times[:3], motion.volume)
    config = IdentifyConfig(contact="sticky", samples_per_frame=1)
    problem = FilmedBody(scene(), motion, SMALL, chosen=np.arange(0, 512, 4))
    objective = Objective(problem, config)
    throw = InitialState.of_world(problem.axes, np.array(VELOCITY), np.array(OMEGA))
    listening = Listening()
    alone, beside = (choose_starting_laws(objective, throw, quiet, workers) for workers in (listening, two))
    assert len(alone) == 2
    efforts = [search_cost(name, modulus) for name, _, _, modulus in listening.heard[1]]
    assert efforts == sorted(efforts, reverse=True)  # or the longest search may begin last, alone
    for a, b in zip(alone, beside, strict=True):
        assert (a.material, a.contact, a.objective) == (b.material, b.contact, b.objective)
        for name, value in a.law.state_dict().items():
            assert torch.equal(value, b.law.state_dict()[name])


def test_laws_that_were_fitted_are_not_fitted_again(tmp_path):
    simulation, config = small_simulation()
    law = {"youngs_modulus": 2.5e4, "poissons_ratio": 0.31}
    throw = {
        f"{n}_{a}": v for n, vs in (("velocity", VELOCITY), ("omega", OMEGA)) for a, v in zip("xyz", vs, strict=True)
    }
    checkpoint = Checkpoint(tmp_path / "refine.pt")
    done = FamilyFit("neo_hookean", "sticky", {**law, **throw, "ground_offset": 0.0}, stage=ALL_FRAMES_STAGE)
    checkpoint.save({"neo_hookean": done.state()})
    unused: Any = None
    (fitted,) = baselines(simulation, unused, config, checkpoint, quiet, Workers())
    assert {n: fitted.values[n] for n in law} == law
    assert fitted.model.contact == "sticky"


@pytest.fixture
def beside(request):
    """Two processes of this machine, or two workers of a Dask scheduler."""
    if request.param == "processes":
        yield request.getfixturevalue("two")
        return
    with workers_for(0, request.getfixturevalue("cluster").scheduler_address) as workers:
        yield workers


@pytest.mark.slow
@pytest.mark.parametrize("beside", ["processes", "dask"], indirect=True)
def test_a_ranking_is_the_same_to_the_bit_side_by_side(beside):
    simulation, _ = small_simulation()
    model = Model(FAMILIES["neo_hookean"], "sticky")
    values = {p.name: p.start for p in simulation.parameters(model)}
    values |= {f"velocity_{a}@run": v for a, v in zip("xyz", VELOCITY, strict=True)}
    values |= {f"omega_{a}@run": v for a, v in zip("xyz", OMEGA, strict=True)}
    simulation.hold_substeps(model, values)
    names = ["linear_drag", "gravity_scale"]
    found = []
    for workers in (Workers(1), beside):
        before = simulation.rollouts
        (base,) = map_tasks(workers, simulation, differentiated, [(model, values, 0)])
        ranking = rank(workers, simulation, base, names, robust_scale=1.0, progress=quiet).candidates
        found.append((base, ranking, simulation.rollouts - before))
    (base, ranking, count), (other_base, other, other_count) = found
    assert count == other_count == len(base.parameters) + 2 + len(names)
    np.testing.assert_array_equal(base.jacobian, other_base.jacobian)
    assert [c.effect for c in ranking] == [c.effect for c in other]
    assert ranking[0].effect == "linear_drag"
    for a, b in zip(ranking, other, strict=True):
        assert a.theta == b.theta
        np.testing.assert_array_equal(a.columns, b.columns)
    alone, apart = (simulation.with_workers(w).finer_grids(model, values, 0) for w in (Workers(1), beside))
    assert len(alone) == len(simulation.setups[0].finer) >= 2
    for a, b in zip(alone, apart, strict=True):
        assert a.any()
        np.testing.assert_array_equal(a, b)


def test_derivatives_in_two_processes_are_those_of_one(two):
    model = LinearModel({"linear_drag": 0.3, "body_force": 0.1})
    fit = baseline(model, ["linear_drag", "body_force"])
    before = model.rollouts
    alone = linearized(model, fit)
    taken = model.rollouts - before
    shared = linearized(model.with_workers(two), fit)
    np.testing.assert_array_equal(shared.jacobians[0], alone.jacobians[0])
    assert model.rollouts == before + 2 * taken


def test_what_diverges_in_another_process_is_left_out(two):
    model = LinearModel({}, diverges=("viscosity",))
    residual = ModelResidual(model.with_workers(two), Model(None, "none", ("viscosity", "linear_drag")))
    values = {"velocity_z": 0.0, "viscosity.strength": 0.0, "linear_drag.strength": 0.0}
    found = residual.batch([{**values, f"{name}.strength": 0.1} for name in ("viscosity", "linear_drag")])
    assert found[0] is None
    np.testing.assert_array_equal(found[1], residual({**values, "linear_drag.strength": 0.1}))


def test_models_are_linearised_once(two):
    model = LinearModel({"linear_drag": 0.3})
    fits = [baseline(model), baseline(model, ["linear_drag"])]
    known = Linearizations(two)
    first = known.of(model, fits[0])
    before = model.rollouts
    linearized(model, fits[1])
    taken, before = model.rollouts - before, model.rollouts
    again, other = known.each(model, fits)
    assert again is first
    assert list(known.each(model, fits)) == [again, other]
    assert model.rollouts == before + taken


def test_evidence_by_derivatives_of_the_model_without_an_effect_is_exact_if_motion_is_linear():
    model = LinearModel({"linear_drag": 0.3})
    base, fit = baseline(model), baseline(model, ["linear_drag"])
    rough, exact = nearly_linearized(model, fit, linearized(model, base)), linearized(model, fit)
    assert [p.name for p in rough.parameters] == [p.name for p in exact.parameters]
    np.testing.assert_allclose(rough.jacobians[0], exact.jacobians[0], atol=1e-9)
    one, other = (weighed(model, [(fit, line)])[0].marginal.log_evidence for line in (rough, exact))
    assert one == pytest.approx(other, rel=1e-9)
