//! CVSim-6: Jacobians, initial pressures, and the truth simulator against an independent one.

use hemostream::model::Model;
use hemostream::model::cvsim6::{Cvsim6, PARAMETERS, Parameter, PulmonaryResistance, SystoleRule};
use hemostream::model::truth::{Change, Simulator};
use proptest::prelude::*;

use crate::support::reference;

fn check_against_reference(file: &str, model: Cvsim6, script: Vec<Change>) {
    let Some(reference) = reference(file) else { return };
    let theta = model.default_parameters();
    let x0 = Cvsim6::initial_pressures(&theta).unwrap();
    let mut patient = Simulator::new(model, x0, theta, script);
    let (mut pressure, mut flow, mut volume) = (0.0_f64, 0.0_f64, 0.0_f64);
    for row in &reference.rows {
        patient.advance_to(row[0]).unwrap();
        let derived = patient.derived();
        let worst = |mine: &[f64], theirs: &[f64]| {
            mine.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        pressure = pressure.max(worst(patient.state(), &row[1..7]));
        flow = flow.max(worst(&derived[..6], &row[7..13]));
        volume = volume.max(worst(&derived[6..], &row[13..19]));
    }
    println!("{file}: pressures {pressure:.1e} mmHg, flows {flow:.1e} mL/s, volumes {volume:.1e} mL");
    assert!(pressure < 1e-4, "{file}: pressure off by {pressure}");
    assert!(flow < 0.05, "{file}: flow off by {flow}");
    assert!(volume < 1e-3, "{file}: volume off by {volume}");
}

#[test]
fn truth_agrees_with_an_independent_stiff_solver() {
    let seconds = Cvsim6::default();
    let fraction = Cvsim6 { systole: SystoleRule::Fraction, ..seconds };
    let nonlinear = Cvsim6 { pulmonary_resistance: PulmonaryResistance::Nonlinear, ..seconds };
    let r_pv = Parameter::RPv as usize;
    let doubled = Change { at_s: 4.0, assignments: vec![(r_pv, 2.0 * PARAMETERS[r_pv].default)] };
    check_against_reference("cvsim6_systole_0.33_seconds.csv", seconds, vec![]);
    check_against_reference("cvsim6_systole_0.33_of_cycle.csv", fraction, vec![]);
    check_against_reference("cvsim6_nonlinear_pulmonary_resistance.csv", nonlinear, vec![]);
    check_against_reference("cvsim6_r_pv_doubles_at_4s.csv", seconds, vec![doubled]);
}

#[test]
fn initial_pressures_are_the_published_ones() {
    let p = Cvsim6::initial_pressures(&Cvsim6::default().default_parameters()).unwrap();
    for (mine, published) in p.iter().zip([6.513419, 87.91907, 6.595897, 0.5270951, 14.233, 7.726997]) {
        assert!((mine - published).abs() < 1e-5 * published, "{mine} against {published}");
    }
}
