//! `hemostream reproduce`: the examples, tables and figures of the paper, one study per file, each with our numbers
//! beside the published ones, and with the `coupled` ensemble beside the paper's.
//!
//! Invariants: the paper's settings are the defaults, what the paper leaves open is written into the report; a study
//! is a function of its settings and its seed, wall time apart.
//! Deliberately absent: anything that the daemon needs. Layers: this one and [`validate`](crate::validate) stand on
//! all others and nothing on them.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use crate::edge::config::ConfigError;
use crate::estimate::settings::SettingsError;
use crate::estimate::time::s_from_ns;
use crate::model::discrepancy::DiscrepancyError;
use crate::model::truth::SimulationError;
use crate::report::Report;
use crate::runtime::clock::Clock;
use crate::runtime::workers::Workers;

mod ablation;
mod circulation;
mod correlation;
mod decomposition;
mod experiment;
mod harmonic;
mod harmonic_ablation;
mod harmonic_discrepancy;
mod harmonic_peers;
mod harmonic_weights;
mod identification;
#[cfg(feature = "peers")]
pub mod peers;
mod resistance;

pub use circulation::paper_config;
use circulation::{Case, CaseRun};

/// A study that can be asked for by name.
pub struct Study {
    /// Name on the command line.
    pub name: &'static str,
    /// What it shows.
    pub about: &'static str,
    run: fn(&Context<'_>) -> Result<Report, StudyError>,
}

impl Study {
    /// Whether this build can do it.
    #[must_use]
    pub fn is_built(&self) -> bool {
        cfg!(feature = "peers") || self.name != "harmonic-peers"
    }
}

/// All studies, in the order of the report.
pub const STUDIES: &[Study] = &[
    Study {
        name: "harmonic",
        about: "benchmark ODE with an unknown parameter, one and 15 subdomains",
        run: harmonic::run,
    },
    Study { name: "harmonic-peers", about: "the same data with PINNs and a Bayesian PINN", run: harmonic_peers::run },
    Study { name: "harmonic-weights", about: "weight of the physics, swept", run: harmonic_weights::run },
    Study { name: "harmonic-discrepancy", about: "a wrong model and what it lacks", run: harmonic_discrepancy::run },
    Study {
        name: "harmonic-ablation",
        about: "members, neurons, activations, distributions",
        run: harmonic_ablation::run,
    },
    Study { name: "identification", about: "black box and gray box: oscillator, Lorenz 63", run: identification::run },
    Study { name: "ablation", about: "CVSim-6 with fewer and fewer sensors, scenarios 1 to 6", run: ablation::run },
    Study { name: "decomposition", about: "uncertainty by source over a beat", run: decomposition::run },
    Study { name: "correlation", about: "correlation of the errors of the six pressures", run: correlation::run },
    Study { name: "resistance", about: "a wrong law of the pulmonary resistance", run: resistance::run },
];

/// A study could not be done.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    /// Settings of an ensemble.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// Settings of a patient.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A study that is not in this build.
    #[error("the peers are not in this build: cargo run --release --features peers -- reproduce ...")]
    NotBuilt,
    /// A peer.
    #[cfg(feature = "peers")]
    #[error(transparent)]
    Peer(#[from] peers::PeerError),
    /// A discrepancy.
    #[error(transparent)]
    Discrepancy(#[from] DiscrepancyError),
    /// The truth.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
}

/// What all studies share.
pub struct Context<'a> {
    /// Small runs, to see whether everything works.
    pub quick: bool,
    /// Threads.
    pub workers: &'a Workers,
    /// Told what is being done.
    pub progress: &'a dyn Fn(&str),
    /// Runs of the circulation that several studies look at.
    cases: RefCell<BTreeMap<Case, Rc<CaseRun>>>,
}

impl<'a> Context<'a> {
    /// Nothing done yet.
    #[must_use]
    pub fn new(quick: bool, workers: &'a Workers, progress: &'a dyn Fn(&str)) -> Self {
        Self { quick, workers, progress, cases: RefCell::default() }
    }

    /// Runs a study.
    ///
    /// # Errors
    /// When an ensemble or a truth cannot be computed.
    pub fn study(&self, study: &Study) -> Result<Report, StudyError> {
        (self.progress)(study.name);
        (study.run)(self)
    }

    /// `full`, or `quick` in a small run.
    fn size<T>(&self, full: T, quick: T) -> T {
        if self.quick { quick } else { full }
    }

    /// A run of the circulation, done once.
    fn case(&self, case: Case) -> Result<Rc<CaseRun>, StudyError> {
        if let Some(run) = self.cases.borrow().get(&case) {
            return Ok(Rc::clone(run));
        }
        (self.progress)(&format!("circulation: {}", case.name()));
        let run = Rc::new(case.run(self)?);
        self.cases.borrow_mut().insert(case, Rc::clone(&run));
        Ok(run)
    }
}

/// What a job gives, and how long it took \[s\].
fn timed<T>(job: impl FnOnce() -> T) -> (T, f64) {
    let clock = Clock::start();
    let value = job();
    (value, s_from_ns(clock.now().0))
}

/// What stands above the studies on the report page.
pub const HEADING: &str = "# The paper, reproduced\n\n\
    De Florio, Zou, Schiavazzi and Karniadakis, *Quantification of total uncertainty in the physics-informed \
    reconstruction of CVSim-6 physiology* (2024): every example, table and figure, computed by the estimator of this \
    project. `independent` is the method of the paper, `coupled` the ensemble that goes past it. Numbers of all tables are \
    in `summary.json`, curves in the CSV files, pictures as PNG and SVG.\n\n";
