//! Units of the columns of our tables.

use std::collections::BTreeMap;

use crate::model::Model;

/// Endings of columns in the unit of what they describe.
const STATISTICS: [&str; 7] = ["_epistemic_sd", "_aleatoric_sd", "_model_sd", "_mean", "_sd", "_q05", "_q95"];

/// Units by name of quantity or parameter.
#[derive(Debug, Clone, Default)]
pub struct Units(BTreeMap<String, String>);

impl Units {
    /// Those of a model: states, derived quantities, parameters and what is read off a heart beat.
    #[must_use]
    pub fn of_model(model: &impl Model) -> Self {
        let quantities = model.states().iter().chain(model.derived()).chain(model.clinical());
        let quantities = quantities.map(|q| (q.name.to_owned(), q.unit.to_owned()));
        let parameters = model.parameters().iter().map(|p| (p.name.to_owned(), p.unit.to_owned()));
        Self(quantities.chain(parameters).collect())
    }

    /// Unit of a column: of a name, or of a statistic of one; empty where nothing is known.
    #[must_use]
    pub fn of_column(&self, column: &str) -> &str {
        if let Some(unit) = self.0.get(column) {
            return unit;
        }
        let described = STATISTICS.iter().find_map(|s| self.0.get(column.strip_suffix(s)?));
        match described {
            Some(unit) => unit,
            None if column.ends_with("_s") => "s",
            None if column.ends_with("_ns") => "ns",
            None => "",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::cvsim6::Cvsim6;

    #[test]
    fn a_column_has_the_unit_of_what_it_describes() {
        let units = Units::of_model(&Cvsim6::default());
        for (column, unit) in [
            ("time_s", "s"),
            ("time_ns", "ns"),
            ("p_a", "mmHg"),
            ("p_a_q05", "mmHg"),
            ("q_li_epistemic_sd", "mL/s"),
            ("c_l_sys_mean", "mL/mmHg"),
            ("r_pv_identifiability", ""),
            ("r_pv_since_informed_s", "s"),
            ("unknown_mean", ""),
        ] {
            assert_eq!(units.of_column(column), unit, "{column}");
        }
    }
}
