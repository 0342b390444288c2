//! Who is watched: the built-in patients, and files of the user.

use std::path::Path;

use super::ValidateError;
use crate::edge::config::Config;

/// The built-in patients, as in `config/patients`: name and text.
pub const BUILT_IN: &[(&str, &str)] = &[
    ("healthy", include_str!("../../config/patients/healthy.toml")),
    ("pulmonary_hypertension_stable", include_str!("../../config/patients/pulmonary_hypertension_stable.toml")),
    ("hemorrhage", include_str!("../../config/patients/hemorrhage.toml")),
    ("vasodilation", include_str!("../../config/patients/vasodilation.toml")),
    ("left_failure", include_str!("../../config/patients/left_failure.toml")),
    ("right_failure", include_str!("../../config/patients/right_failure.toml")),
    ("tachycardia", include_str!("../../config/patients/tachycardia.toml")),
];

/// Somebody to watch.
#[derive(Debug, Clone)]
pub struct TwinPatient {
    /// Name in tables.
    pub name: String,
    /// What is true: `[patient]`, and the noise of the sensors in `[channels]`.
    pub config: Config,
}

/// All built-in patients.
///
/// # Errors
/// When a file that is part of the program is not valid, which a test checks.
pub fn built_in() -> Result<Vec<TwinPatient>, ValidateError> {
    BUILT_IN.iter().map(|(name, _)| find(name)).collect()
}

/// A built-in patient by its name, or else that of a file.
///
/// # Errors
/// When there is neither, or the file is not valid.
pub fn find(name_or_file: &str) -> Result<TwinPatient, ValidateError> {
    let patient = |name: &str, config| TwinPatient { name: name.to_owned(), config };
    if let Some((name, text)) = BUILT_IN.iter().find(|(name, _)| *name == name_or_file) {
        return Ok(patient(name, Config::load_text(&format!("config/patients/{name}.toml"), text)?));
    }
    let path = Path::new(name_or_file);
    let is_toml = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("toml"));
    if !is_toml && !path.exists() {
        let known = BUILT_IN.iter().map(|(name, _)| *name).collect();
        return Err(ValidateError::UnknownPatient { found: name_or_file.to_owned(), known });
    }
    let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or(name_or_file);
    // The environment speaks to the estimator and must not change the truth.
    Ok(patient(stem, Config::load_from(Some(path), [], &[])?.0))
}

/// Several patients, each once.
///
/// # Errors
/// As [`find`], and when two have the same name.
pub fn find_all(names_or_files: &[String]) -> Result<Vec<TwinPatient>, ValidateError> {
    let all = names_or_files.iter().map(|name| find(name)).collect::<Result<Vec<_>, _>>()?;
    let again = |(i, patient): (usize, &TwinPatient)| all[..i].iter().any(|other| other.name == patient.name);
    match all.iter().enumerate().find(|entry| again(*entry)) {
        Some((_, patient)) => Err(ValidateError::PatientTwice(patient.name.clone())),
        None => Ok(all),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn every_patient_is_valid_and_has_a_start() {
        for TwinPatient { name, config } in built_in().unwrap() {
            let pressures = config.patient.initial_pressures().unwrap();
            println!("{name}: {pressures:.2?}");
            assert!(pressures.iter().all(|p| p.is_finite()), "{name}");
            // In order around the circulation: arteries above veins, on both sides.
            assert!(pressures[1] > pressures[2] && pressures[4] > pressures[5], "{name}: {pressures:?}");
            assert!(config.patient.script.is_empty(), "{name}: what happens is the business of the scenario");
        }
    }

    #[test]
    fn who_is_unknown_or_repeated_is_refused() {
        let unknown = find("helthy").unwrap_err().to_string();
        assert!(unknown.contains("`helthy`") && unknown.contains("healthy, pulmonary"), "{unknown}");
        let twice = find_all(&["healthy".to_owned(), "healthy".to_owned()]).unwrap_err().to_string();
        assert!(twice.contains("twice"), "{twice}");
    }
}
