//! `harmonic-peers`: X-TFC beside an ensemble of PINNs and a Bayesian PINN, on one record, timed in one run.

#[cfg(feature = "peers")]
pub(super) use study::run;

/// Says how to get it.
#[cfg(not(feature = "peers"))]
pub(super) fn run(_: &super::Context<'_>) -> Result<super::Report, super::StudyError> {
    Err(super::StudyError::NotBuilt)
}

#[cfg(feature = "peers")]
mod study {
    use crate::estimate::statistics::mean_and_sd;
    use crate::model::harmonic::Harmonic;
    use crate::report::plot::{Chart, Colour, Figure};
    use crate::report::{Report, Table, mean, plus_minus, rms, short};
    use crate::reproduce::harmonic::{
        DATA_UNTIL_S, HORIZON_S, K, K_GUESS, NOISE_SD, Setup, X0, error_and_band, grid, k_of, shared_record,
    };
    use crate::reproduce::peers::{BayesianSettings, PinnSettings, Task, bayesian, pinn};
    use crate::reproduce::{Context, StudyError, timed};

    /// A method, its `k`, what it predicts, how long it took.
    struct Finding {
        key: &'static str,
        name: &'static str,
        published: &'static str,
        k: (f64, f64),
        /// Time, mean and sd of `x`.
        curve: Vec<(f64, f64, f64)>,
        wall_s: f64,
        note: String,
    }

    pub(in crate::reproduce) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
        let mut report =
            Report::new("harmonic-peers", "Harmonic example: X-TFC, an ensemble of PINNs, a Bayesian PINN");
        report.text(
            "The record of `harmonic`, the same guess of k, one machine, one run, one after the other on as many threads \
             as X-TFC has. PINN: one hidden layer of 50 tanh, Adam at 1e-3, 30,000 iterations, ten members, each with a start \
             and a noisy copy of the data of its own (from their starts alone they would not differ), 100 collocation points. Bayesian PINN: the same network, prior N(0, 1) on weights, Hamiltonian \
             Monte Carlo with 2,000 draws of burn-in and 1,000 samples in each of two chains, trajectories of 63 leapfrog \
             steps, step size adapted; residual sd 0.1 at 30 points, start sd 0.05, prior sd 0.5 of k and \
             3,000 steps of Adam before the chains start are open in the paper.",
        );
        let results = [xtfc(context)?, pinns(context)?, bayesian_pinn(context)?];
        let exact = |t: f64| Harmonic::default().exact(t, X0, K);
        let mut table = Table::new([
            "",
            "k, paper (wall)",
            "k, here",
            "wall, here [s]",
            "x, rms error in [5, 10]",
            "sd in [5, 10]",
            "",
        ]);
        let mut figure = Figure::new("Harmonic example, three methods on one record", 3);
        let samples = shared_record();
        let reference = results[0].wall_s;
        for result in results {
            let later = || result.curve.iter().filter(|(t, ..)| *t > DATA_UNTIL_S);
            let error = rms(later().map(|(t, m, _)| m - exact(*t)));
            let band = mean(later().map(|(.., sd)| *sd));
            let figures = [
                ("k_mean", result.k.0),
                ("k_sd", result.k.1),
                ("wall_s", result.wall_s),
                ("wall_over_xtfc", result.wall_s / reference),
                ("extrapolation_rms_error", error),
            ];
            figures.iter().for_each(|(name, value)| report.figure(&format!("{}.{name}", result.key), *value));
            table.row([
                result.name.to_owned(),
                result.published.to_owned(),
                plus_minus(result.k.0, result.k.1),
                format!("{} (x {:.0})", short(result.wall_s), result.wall_s / reference),
                short(error),
                short(band),
                result.note,
            ]);
            let edges = result.curve.iter().map(|(t, m, sd)| (*t, m - 2.0 * sd, m + 2.0 * sd)).collect();
            let chart = Chart::new(result.name, "t [s]", "x")
                .region("no data", DATA_UNTIL_S, HORIZON_S)
                .band("2 sd", edges, Colour::Orange)
                .line("mean", result.curve.iter().map(|(t, m, _)| (*t, *m)).collect(), Colour::Blue)
                .dashed("exact", grid().iter().map(|&t| (t, exact(t))).collect(), Colour::Black)
                .points("data", samples.iter().map(|s| (s.time_s, s.value)).collect(), Colour::Vermilion)
                .y_range(8.0, 12.0);
            figure = figure.panel(chart);
            let rows = result.curve.iter().map(|(t, m, sd)| vec![*t, exact(*t), *m, *sd]).collect();
            report.series(&format!("harmonic_peers_{}", result.key), ["time_s", "exact", "mean", "sd"], rows);
        }
        report.table(table);
        report.picture("harmonic_peers", figure, "Mean and two standard deviations of the three methods.");
        Ok(report)
    }

    fn xtfc(context: &Context<'_>) -> Result<Finding, StudyError> {
        let (trace, wall_s) = Setup::new(context.size(1000, 100), 1).run(&shared_record(), context)?;
        let (_, band) = error_and_band(&trace, |t| Harmonic::default().exact(t, X0, K), DATA_UNTIL_S, HORIZON_S);
        Ok(Finding {
            key: "xtfc",
            name: "MC X-TFC, 1,000 members",
            published: "0.9840 ± 0.0536 (17.12 s)",
            k: k_of(&trace),
            curve: trace.quantity(0).map(|(t, s)| (t, s.mean, s.epistemic_sd)).collect(),
            wall_s,
            note: format!("epistemic sd {}", short(band)),
        })
    }

    fn pinns(context: &Context<'_>) -> Result<Finding, StudyError> {
        (context.progress)("harmonic-peers: ensemble of PINNs");
        let paper = PinnSettings::default();
        let settings = PinnSettings { iterations: context.size(paper.iterations, 300), noisy_copies: true, ..paper };
        let (outcome, wall_s) = with_task(context, |task| pinn(task, &settings));
        let outcome = outcome?;
        let half_way = mean(outcome.diagnostics.iter().map(|fit| fit.k_half_way));
        let loss = mean(outcome.diagnostics.iter().map(|fit| fit.loss));
        Ok(Finding {
            key: "pinn",
            name: "10 PINNs",
            published: "0.9313 ± 0.0317 (55.28 s)",
            k: mean_and_sd(&outcome.k),
            curve: curve(&outcome.x),
            wall_s,
            note: format!("loss {loss:.1e}; k half way {half_way:.4}"),
        })
    }

    fn bayesian_pinn(context: &Context<'_>) -> Result<Finding, StudyError> {
        (context.progress)("harmonic-peers: Bayesian PINN");
        let paper = BayesianSettings::default();
        let settings = BayesianSettings {
            burn_in: context.size(paper.burn_in, 40),
            samples: context.size(paper.samples, 20),
            warm_up: context.size(paper.warm_up, 200),
            ..paper
        };
        let (outcome, wall_s) = with_task(context, |task| bayesian(task, &settings));
        let outcome = outcome?;
        let mixing = &outcome.diagnostics;
        Ok(Finding {
            key: "bayesian_pinn",
            name: "Bayesian PINN",
            published: "0.9595 ± 0.0354 (28.29 s)",
            k: mean_and_sd(&outcome.k),
            curve: curve(&outcome.x),
            wall_s,
            note: format!(
                "acceptance {:.2}, R-hat of k {:.3}, effective samples {:.0}",
                mean(mixing.acceptance.iter().copied()),
                mixing.r_hat,
                mixing.effective_samples
            ),
        })
    }

    fn with_task<T: Send>(context: &Context<'_>, job: impl FnOnce(&Task<'_>) -> T + Send) -> (T, f64) {
        let data: Vec<(f64, f64)> = shared_record().iter().map(|s| (s.time_s, s.value)).collect();
        let times = grid();
        timed(|| {
            context.workers.install(|| {
                job(&Task {
                    data: &data,
                    noise_sd: NOISE_SD,
                    x0: X0,
                    horizon: HORIZON_S,
                    k_guess: K_GUESS,
                    predict_at: &times,
                    seed: 1,
                    progress: &|_| {},
                })
            })
        })
    }

    fn curve(x: &[Vec<f64>]) -> Vec<(f64, f64, f64)> {
        let at = |i: usize| mean_and_sd(&x.iter().map(|x| x[i]).collect::<Vec<_>>());
        grid().into_iter().enumerate().map(|(i, t)| (t, at(i).0, at(i).1)).collect()
    }
}
