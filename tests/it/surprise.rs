//! Samples that are further off than noise explains: members have learnt from them by the time it is noticed, and learn
//! anew.

use hemostream::estimate::ensemble::{Ensemble, Observation, Serial, Snapshot};
use hemostream::estimate::settings::{Adaptation, CouplingKind, EstimatorSettings};
use hemostream::estimate::time::EventTime;
use hemostream::model::Model;
use hemostream::model::cvsim6::{Cvsim6, Parameter, State};
use hemostream::model::truth::Simulator;

const H_S: f64 = 0.005;

/// An ensemble, and the arterial pressure of its patient at the end of every window.
struct Bed {
    ensemble: Ensemble<Cvsim6>,
    patient: Simulator<Cvsim6>,
    windows: u32,
}

impl Bed {
    fn new() -> Self {
        let settings = super::twin::settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv]);
        let settings = EstimatorSettings { members: 40, adaptation: Adaptation::ON, ..settings };
        let model = Cvsim6::default();
        let theta = model.default_parameters();
        let patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
        let mut ensemble = Ensemble::new(model, settings, &Serial).unwrap();
        ensemble.follow_beats(EventTime(0));
        Self { ensemble, patient, windows: 0 }
    }

    /// One window, with samples at its end that are off by this \[mmHg\].
    fn window(&mut self, off: f64) {
        self.windows += 1;
        self.patient.advance_to(f64::from(self.windows) * H_S).unwrap();
        let value = |state: State| self.patient.state()[state as usize];
        let observations = [(0, value(State::A) + off), (1, value(State::Pa))];
        let observations = observations.map(|(channel, value)| Observation { s: 1.0, channel, value });
        self.ensemble.step(&observations, &Serial);
    }
}

/// What was learnt too early leaves no trace: an ensemble that expected a surprise ends in the same place, bit by bit.
#[test]
fn members_learn_anew_from_a_sample_that_is_far_off() {
    let (mut unaware, mut warned) = (Bed::new(), Bed::new());
    for bed in [&mut unaware, &mut warned] {
        (0..20).for_each(|_| bed.window(0.5));
    }
    // Nothing is learnt from this one, whatever it says; it warns all the same.
    for (bed, off) in [(&mut unaware, 0.0), (&mut warned, 60.0)] {
        bed.ensemble.listen(false);
        bed.window(off);
        bed.ensemble.listen(true);
    }
    assert_eq!(unaware.ensemble.members_at_end(), warned.ensemble.members_at_end());
    for off in [60.0, 0.0, 0.3, 60.0, 60.0, 0.1] {
        unaware.window(off);
        warned.window(off);
        assert_eq!(unaware.ensemble.members_at_end(), warned.ensemble.members_at_end());
        assert_eq!(unaware.ensemble.findings(), warned.ensemble.findings());
    }
}

/// What is read off a beat is what the estimates did in it, however often members learnt anew.
#[test]
fn surprises_are_in_the_beat_once() {
    let mut bed = Bed::new();
    let (mut pressures, mut scratch) = (Vec::new(), Snapshot::default());
    for window in 0..600 {
        bed.window(if window % 3 == 0 { 30.0 } else { 0.0 });
        pressures.push(bed.ensemble.summarise_at(1.0, &mut scratch, &Serial)[State::A as usize].mean);
    }
    let beats = bed.ensemble.take_beats(true);
    let mean = Cvsim6::default().clinical().iter().position(|q| q.name == "p_a_mean").unwrap();
    assert!(beats.len() >= 2, "{}", beats.len());
    for beat in &beats {
        let within = |(k, _): &(usize, &f64)| {
            let time = (*k as f64 + 1.0) * H_S;
            time > beat.start.as_s() && time <= beat.end.as_s()
        };
        let own: Vec<f64> = pressures.iter().enumerate().filter(within).map(|(_, p)| *p).collect();
        let expected = own.iter().sum::<f64>() / own.len() as f64;
        let found = beat.values[mean].mean;
        assert!((found - expected).abs() < 0.5, "{found} {expected}");
    }
}
