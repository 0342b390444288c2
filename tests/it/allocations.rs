//! Once a bed is under way its windows are solved in the memory that is there.

use allocation_counter::measure;
use hemostream::edge::config::Config;
use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimator, Input, Output};
use hemostream::estimate::settings::CouplingKind;
use hemostream::estimate::time::{ArrivalTime, EventTime};
use hemostream::estimate::window::RawSample;
use hemostream::model::Model;
use hemostream::model::cvsim6::Cvsim6;
use hemostream::model::truth::Simulator;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

const RATE_HZ: i64 = 125;

/// On a quantity, on a figure of a beat and on a parameter.
const ALARMS: &str = "alarms=[{ name = \"a\", quantity = \"p_a\", above = 300 }, \
                      { name = \"b\", quantity = \"cardiac_output\", below = 1 }, \
                      { name = \"c\", quantity = \"r_pv\", above = 1 }]";

/// Drives a bed through some beats; of every handled sample, how much was allocated, and how many windows and messages
/// came of it.
fn drive(sets: &[&str]) -> Vec<(i64, u64, usize, usize)> {
    let sets: Vec<String> = sets.iter().map(|s| (*s).to_owned()).collect();
    let config = Config::load_from(None, [], &sets).unwrap().0;
    let mut estimator = Estimator::new(config.circulation().unwrap(), config.estimator_settings().unwrap()).unwrap();
    let (model, channels) = (Cvsim6::default(), estimator.settings().channels.clone());
    let theta = model.default_parameters();
    let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
    let independent = estimator.settings().coupling == CouplingKind::Independent;
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut out = Vec::with_capacity(64);
    let mut told = Vec::new();
    for k in 0..8 * RATE_HZ {
        let time = EventTime(k * 1_000_000_000 / RATE_HZ);
        patient.advance_to(time.as_s()).unwrap();
        for (channel, sensor) in channels.iter().enumerate() {
            let noise: f64 = StandardNormal.sample(&mut rng);
            let value = patient.state()[sensor.state] + sensor.noise_sd_mmhg * noise;
            let input = Input::Samples { channel, samples: vec![RawSample { time, value }] };
            out.clear();
            let counted = measure(|| estimator.handle(input, ArrivalTime(time.0), &Serial, &mut out));
            let windows = out.iter().filter(|output| matches!(output, Output::Window(_))).count();
            // Of independent members, the first that a batch leaves to the general solver still costs one allocation.
            let left = |output: &Output| matches!(output, Output::Window(window) if window.report.one_by_one > 0);
            if independent && out.iter().any(left) {
                continue;
            }
            told.push((time.0, counted.count_total, windows, out.len() - windows));
        }
    }
    told
}

#[test]
fn windows_allocate_nothing() {
    let three = "observed=[\"p_a\", \"p_v\", \"p_pa\"]";
    let rate = "estimator.estimate=[\"r_pv\", \"c_a\", \"heart_rate\"]";
    for (sets, what) in [
        (vec![three, "window.length_s=0.004"], "coupled, 4 ms"),
        (vec![three, "window.length_s=0.001"], "coupled, 1 ms"),
        (vec![three, "window.length_s=0.004", rate], "coupled, with the heart rate"),
        (vec![three, "window.length_s=0.004", ALARMS], "coupled, with limits that are kept"),
        (vec![three, "window.length_s=0.004", "estimator.coupling=independent"], "independent"),
    ] {
        let told = drive(&sets);
        // The first beats find vectors and places for all that there may be.
        let later = |at: &&(i64, u64, usize, usize)| at.0 >= 4_000_000_000;
        let quiet: Vec<_> =
            told.iter().filter(later).filter(|(_, _, windows, said)| *windows > 0 && *said == 0).collect();
        let windows: usize = quiet.iter().map(|(_, _, windows, _)| windows).sum();
        let with: Vec<_> = quiet.iter().filter(|(_, allocated, _, _)| *allocated > 0).collect();
        println!(
            "{what}: {windows} windows, allocations in {} of {}: {:?}",
            with.len(),
            quiet.len(),
            with.iter().take(10).collect::<Vec<_>>()
        );
        assert!(windows > 200, "{what}: {windows} windows without a message");
        assert!(with.is_empty(), "{what}: {with:?}");
        let said: Vec<_> = told.iter().filter(later).filter(|(_, _, _, said)| *said > 0).collect();
        let most = said.iter().map(|(_, allocated, _, said)| allocated / *said as u64).max().unwrap_or(0);
        println!("{what}: at most {most} allocations per message");
    }
}
