//! One window of a batch of eight members: the kernels on every instruction set, and the general solver beside them.
//! Times are per member and window (throughput: elements are member-windows).
#![allow(missing_docs, clippy::unwrap_used)]

use std::hint::black_box;
use std::time::Duration;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use hemostream::estimate::coupling::coupled::square;
use hemostream::estimate::coupling::coupled_unknowns;
use hemostream::model::Model;
use hemostream::model::cvsim6::{Cvsim6, Parameter, State};
use hemostream::model::lanes::{InstructionSet, Lanes, WIDTH};
use hemostream::model::truth::Simulator;
use hemostream::xtfc::basis::Basis;
use hemostream::xtfc::collocation::CollocationSolver;
use hemostream::xtfc::features::{FeatureSpec, RandomFeatures};
use hemostream::xtfc::problem::{Datum, Prior, Solution, Stopping, Unknowns, WindowProblem};
use hemostream::xtfc::sweeps::{
    Covariance, Expressions, FitScratch, Freedom, Samples, Shared, Solutions, fit, forecast,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const WEIGHTS: [f64; 6] = [1.0; 6];

const NOISE: [f64; 6] = [2.07, 2.06, 0.146, 0.408, 0.40, 0.242];

/// Moments spread over a beat, so that valves open and close as often as they do.
const MOMENTS: u32 = 32;

/// Eight members at a moment of a beat, and three samples for them.
struct Case {
    xs: Vec<Vec<f64>>,
    theta: Vec<f64>,
    values: Vec<Lanes>,
}

const OBSERVED: [State; 3] = [State::A, State::V, State::Pa];

fn cases() -> Vec<Case> {
    let model = Cvsim6::default();
    let theta = model.default_parameters();
    let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
    let case = |k: u32| {
        patient.advance_to(2.0 + 0.833 * f64::from(k) / f64::from(MOMENTS)).unwrap();
        let wobble = |s: usize, lane: usize| 0.3 * NOISE[s] * (1.7 * s as f64 + 3.1 * lane as f64 + f64::from(k)).sin();
        let state = patient.state().to_vec();
        let off = |s: State, lane: usize| {
            let s = s as usize;
            state[s] + NOISE[s] * (2.3 * lane as f64 + 0.7 * s as f64).cos()
        };
        Case {
            xs: (0..WIDTH).map(|lane| (0..6).map(|s| state[s] + wobble(s, lane)).collect()).collect(),
            theta: patient.parameters().to_vec(),
            values: OBSERVED.map(|s| Lanes(std::array::from_fn(|lane| off(s, lane)))).to_vec(),
        }
    };
    (0..MOMENTS).map(case).collect()
}

fn bases(length_s: f64, neurons: usize) -> Vec<Basis> {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let spec = FeatureSpec { count: neurons, nodes: neurons, ..FeatureSpec::default() };
    let draws = std::iter::repeat_with(|| Basis::new(RandomFeatures::draw(spec, &mut rng).unwrap(), length_s).unwrap());
    draws.filter(Basis::is_nodal).take(WIDTH).collect()
}

fn solutions(case: &Case) -> Solutions {
    Solutions {
        start: (0..6).map(|s| Lanes(std::array::from_fn(|lane| case.xs[lane][s]))).collect(),
        theta: case.theta.iter().map(|v| Lanes::splat(*v)).collect(),
        ..Solutions::default()
    }
}

/// What `coupled` has in common for all members.
struct Coupled {
    unknowns: Unknowns,
    root: Vec<f64>,
    covariance: Vec<f64>,
    weights: Vec<f64>,
    states: Vec<usize>,
}

impl Coupled {
    fn new(model: &Cvsim6) -> Self {
        let chosen = [Parameter::RPv as usize, Parameter::CA as usize];
        let transforms: Vec<_> = chosen.iter().map(|&p| model.parameters()[p].transform).collect();
        let sd = |i: usize| if i < 6 { 0.3 * NOISE[i] } else { 0.05 };
        let root: Vec<f64> = (0..64)
            .map(|k| (k / 8, k % 8))
            .map(|(i, j)| {
                if i == j {
                    sd(i)
                } else if i > j {
                    0.2 * sd(i)
                } else {
                    0.0
                }
            })
            .collect();
        let mut covariance = Vec::new();
        square(&root, 8, &mut covariance);
        Self {
            unknowns: coupled_unknowns(model, &chosen, &transforms),
            covariance,
            root,
            weights: OBSERVED.iter().map(|s| 1.0 / NOISE[*s as usize]).collect(),
            states: OBSERVED.iter().map(|s| *s as usize).collect(),
        }
    }
}

fn windows(criterion: &mut Criterion) {
    let (model, cases) = (Cvsim6::default(), cases());
    let coupled = Coupled::new(&model);
    for length_ms in [1.0, 4.0] {
        let bases = bases(length_ms / 1e3, 5);
        let expressions = Expressions::new(&bases).unwrap();
        let at_sample: Vec<Lanes> = {
            let row = |basis: &Basis| {
                let mut row = vec![0.0; basis.rank()];
                basis.values_at(0.7, &mut row);
                row
            };
            let rows: Vec<Vec<f64>> = bases.iter().map(row).collect();
            (0..5).map(|k| Lanes(std::array::from_fn(|lane| rows[lane][k]))).collect()
        };
        let phi = at_sample.repeat(3);
        let mut group = criterion.benchmark_group(format!("window of {length_ms} ms"));
        group.throughput(Throughput::Elements(u64::from(MOMENTS) * WIDTH as u64));
        group.warm_up_time(Duration::from_millis(500)).measurement_time(Duration::from_secs(2)).sample_size(20);
        for set in InstructionSet::ALL.into_iter().filter(|set| set.is_available()) {
            let mut batches: Vec<Solutions> = cases.iter().map(solutions).collect();
            // Worked out once for a hundred members: on its own.
            let phase = [Parameter::BeatPhase as usize];
            let mut shared: Vec<Shared<Cvsim6>> = (batches.iter())
                .map(|batch| Shared::new(model, &batch.theta, &coupled.unknowns.parameters).unwrap())
                .collect();
            group.bench_function(BenchmarkId::new("what all members share", set.name()), |bencher| {
                bencher.iter(|| {
                    for (shared, batch) in shared.iter_mut().zip(&batches) {
                        shared.begin(&batch.theta, &phase, &expressions, set);
                    }
                });
            });
            group.bench_function(BenchmarkId::new("without samples", set.name()), |bencher| {
                bencher.iter(|| {
                    for (shared, batch) in shared.iter().zip(&mut batches) {
                        black_box(forecast(shared, &expressions, 1e-9, set, batch));
                    }
                });
            });
            let (mut scratch, mut batch) = (FitScratch::default(), Solutions::default());
            group.bench_function(BenchmarkId::new("three samples, coupled", set.name()), |bencher| {
                bencher.iter(|| {
                    for ((case, from), shared) in cases.iter().zip(&batches).zip(&shared) {
                        batch.clone_from(from);
                        let samples = Samples {
                            states: &coupled.states,
                            weights: &coupled.weights,
                            phi: &phi,
                            values: &case.values,
                        };
                        let freedom = Freedom {
                            unknowns: &coupled.unknowns,
                            covariance: Covariance::Shared(&coupled.covariance),
                            physics_weights: &WEIGHTS,
                            precision: None,
                        };
                        let places = (&mut scratch, &mut batch);
                        black_box(fit(shared, &expressions, &samples, &freedom, 1e-9, set, places));
                    }
                });
            });
        }
        let (mut solver, mut out) = (CollocationSolver::default(), Solution::default());
        let nothing_free = Unknowns::default();
        for with_samples in [false, true] {
            let name = if with_samples { "three samples, coupled" } else { "without samples" };
            group.bench_function(BenchmarkId::new(name, "general solver"), |bencher| {
                bencher.iter(|| {
                    for case in &cases {
                        for (lane, basis) in bases.iter().enumerate() {
                            let data: Vec<Datum> = (0..3)
                                .map(|j| Datum {
                                    s: 0.7,
                                    state: coupled.states[j],
                                    value: case.values[j].0[lane],
                                    weight: coupled.weights[j],
                                })
                                .collect();
                            let problem = WindowProblem {
                                model: &model,
                                basis,
                                start: &case.xs[lane],
                                theta: &case.theta,
                                unknowns: if with_samples { &coupled.unknowns } else { &nothing_free },
                                prior: if with_samples { Prior { root: &coupled.root, n_xi: 8 } } else { Prior::NONE },
                                data: if with_samples { &data } else { &[] },
                                physics_weights: &WEIGHTS,
                                stopping: Stopping::default(),
                            };
                            solver.solve(&problem, &mut out);
                        }
                    }
                });
            });
        }
        group.finish();
    }
}

/// Independent products and sums, as many as there are registers for in every instruction set: the peak of the processor
/// without fused multiply-add, which the kernels do without. Elements are floating-point operations.
struct Peak {
    values: [Lanes; CHAINS],
    rounds: usize,
}

const CHAINS: usize = 6;

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for Peak {
    type Output = [Lanes; CHAINS];

    #[inline(always)]
    fn call(self) -> Self::Output {
        let (factor, term) = (Lanes::splat(0.999), Lanes::splat(0.001));
        // One by one, so that they stay in registers.
        let [mut a, mut b, mut c, mut d, mut e, mut f] = self.values;
        for _ in 0..self.rounds {
            a = a * factor + term;
            b = b * factor + term;
            c = c * factor + term;
            d = d * factor + term;
            e = e * factor + term;
            f = f * factor + term;
        }
        [a, b, c, d, e, f]
    }
}

fn peak(criterion: &mut Criterion) {
    const ROUNDS: usize = 1000;
    let mut group = criterion.benchmark_group("peak");
    group.throughput(Throughput::Elements((2 * WIDTH * CHAINS * ROUNDS) as u64));
    group.warm_up_time(Duration::from_millis(500)).measurement_time(Duration::from_secs(2)).sample_size(20);
    for set in InstructionSet::ALL.into_iter().filter(|set| set.is_available()) {
        group.bench_function(BenchmarkId::from_parameter(set.name()), |bencher| {
            let values = std::array::from_fn(|chain| Lanes::splat(chain as f64));
            bencher.iter(|| set.run(Peak { values: black_box(values), rounds: ROUNDS }));
        });
    }
    group.finish();
}

criterion_group!(benches, windows, peak);
criterion_main!(benches);
