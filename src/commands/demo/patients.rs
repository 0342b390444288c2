//! The patients of the demo: one config for the estimator, three different truths.

use std::fmt::Write;

use hemostream::edge::config::Config;
use hemostream::edge::replay::{Bed, Source};
use hemostream::edge::synthetic::draw_start;

use super::super::Failure;

/// Somebody in a bed.
struct Patient {
    bed: &'static str,
    /// Over the settings of the demo; the estimator is not told.
    sets: &'static [&'static str],
    in_crisis: bool,
}

/// What the summary is about.
pub(super) const CRISIS_BED: &str = "icu-3";

const PATIENTS: [Patient; 3] = [
    Patient { bed: "icu-1", sets: &[], in_crisis: false },
    // Stiff arteries and a high resistance: hypertension.
    Patient { bed: "icu-2", sets: &["patient.c_a=1.2", "patient.r_a=1.25"], in_crisis: false },
    Patient { bed: CRISIS_BED, sets: &[], in_crisis: true },
];

/// A pulmonary embolism and its treatment, again and again: from when on, and how often \[s\].
const CRISIS: (u32, u32, u32) = (15, 75, 120);
/// An evening.
const CRISES: u32 = 240;

/// Every patient in a bed; `sets` are the settings of the demo and then those of the user.
pub(super) fn beds(sets: &[String], seed: u64) -> Result<Vec<Bed>, Failure> {
    let bed = |(patient, seed): (&Patient, u64)| {
        let own = patient.sets.iter().map(|set| (*set).to_owned()).chain(patient.in_crisis.then(crises));
        // What the user sets goes over all.
        let (demo, user) = sets.split_at(super::SETTINGS.len().min(sets.len()));
        let all: Vec<String> = demo.iter().cloned().chain(own).chain(user.iter().cloned()).collect();
        let (mut config, _) = Config::load(None, &all)?;
        // The patient starts somewhere in what the estimator is told of the start, and so with a blood volume that it
        // does not know.
        draw_start(&mut config, seed)?;
        Ok(Bed::new(patient.bed, Source::synthetic(&config, seed)?))
    };
    PATIENTS.iter().zip(seed..).map(bed).collect()
}

/// The script of the crises as a setting.
fn crises() -> String {
    let (begins_s, ends_s, every_s) = CRISIS;
    let mut script = String::from("patient.script=[");
    for i in 0..CRISES {
        let (begins, ends) = (begins_s + i * every_s, ends_s + i * every_s);
        // Writing to a string does not fail.
        let _ = write!(script, "{{ at_s = {begins}.0, scale = {{ r_pv = 4.0, r_a = 0.8 }} }}, ");
        let _ = write!(script, "{{ at_s = {ends}.0, scale = {{ r_pv = 0.25, r_a = 1.25 }} }}, ");
    }
    script.push(']');
    script
}
