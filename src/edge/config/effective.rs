//! The configuration that results from all layers: as a list with origins, as text, as a hash.

use std::fmt::Write;

use figment::value::Value;
use serde::Serialize;

use super::keys::KeyPath;
use super::lines::Lines;
use super::schema::Config;

/// What cannot change an estimate, and therefore does not enter [`Config::hash`].
const NOT_HASHED: &[&[&str]] = &[&["zenoh"], &["service"], &["publish", "prefix"]];

/// Longest setting for which origins are still aligned.
const MAX_ALIGNED: usize = 60;

/// One effective setting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Setting {
    /// Dotted key.
    pub key: String,
    /// Value as TOML.
    pub value: String,
    /// `default`, the path of the file, `environment NAME` or `--set`.
    pub origin: String,
    /// The key without its table, and the table (empty at the top level).
    section: (String, String),
}

/// Every effective setting and where it comes from, in the order of the schema.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origins(Vec<Setting>);

impl Origins {
    /// `origin` tells where a key was set.
    pub(super) fn new(config: &Config, origin: impl Fn(&KeyPath) -> String) -> Self {
        // The order of declaration survives only in the text that serde writes.
        let order = Lines::of(&toml::to_string(config).unwrap_or_default());
        let mut leaves = leaves(config);
        leaves.sort_by_key(|(path, _)| order.get(path));
        let setting = |(path, value): (KeyPath, Value)| {
            let (table, inner) = path.0.split_at(usize::from(path.0.len() > 1));
            let section = (KeyPath(inner.to_vec()).to_string(), table.concat());
            Setting { key: path.to_string(), value: toml_text(&value), origin: origin(&path), section }
        };
        Self(leaves.into_iter().map(setting).collect())
    }

    /// The settings in order.
    pub fn iter(&self) -> impl Iterator<Item = &Setting> {
        self.0.iter()
    }

    /// The setting with a dotted key.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Setting> {
        self.0.iter().find(|setting| setting.key == key)
    }
}

impl Config {
    /// A hash of all settings that can change an estimate or an alarm: everything except `[zenoh]`, `[service]` and
    /// `publish.prefix`. The same on every machine and in every run.
    #[must_use]
    pub fn hash(&self) -> u64 {
        let mut text = String::new();
        for (path, value) in leaves(self) {
            if !NOT_HASHED.iter().any(|start| path.starts_with(start)) {
                // Writing to a string cannot fail.
                let _ = writeln!(text, "{path} = {}", toml_text(&value));
            }
        }
        fnv1a_64(text.as_bytes())
    }
}

/// The effective settings as a TOML file that loads to the same configuration, origins as comments.
#[must_use]
pub fn render(config: &Config, origins: &Origins) -> String {
    let assignment = |setting: &Setting| format!("{} = {}", setting.section.0, setting.value);
    let lengths = origins.iter().map(|setting| assignment(setting).chars().count());
    let width = lengths.filter(|&length| length <= MAX_ALIGNED).max().unwrap_or(0);

    let mut text = format!("# config hash {:016x}\n", config.hash());
    let mut table = "";
    for setting in origins.iter() {
        if setting.section.1 != table {
            table = &setting.section.1;
            let _ = writeln!(text, "\n[{table}]");
        }
        let _ = writeln!(text, "{:width$}  # {}", assignment(setting), setting.origin);
    }
    text
}

/// Every value that is not a table, and every empty table, in alphabetical order of the keys.
pub(super) fn leaves(config: &Config) -> Vec<(KeyPath, Value)> {
    let mut leaves = Vec::new();
    collect_leaves(KeyPath::default(), to_value(config), &mut leaves);
    leaves
}

fn collect_leaves(path: KeyPath, value: Value, leaves: &mut Vec<(KeyPath, Value)>) {
    match value {
        Value::Empty(..) => {}
        Value::Dict(tag, mut entries) => {
            entries.retain(|_, value| !matches!(value, Value::Empty(..)));
            if entries.is_empty() {
                leaves.push((path, Value::Dict(tag, entries)));
            } else {
                for (name, value) in entries {
                    collect_leaves(path.join(name), value, leaves);
                }
            }
        }
        value => leaves.push((path, value)),
    }
}

/// A configuration as a tree. Its types have string keys and plain values only, so that cannot fail.
pub(super) fn to_value(config: &Config) -> Value {
    Value::serialize(config).unwrap_or_else(|_| Value::from(figment::value::Dict::new()))
}

/// A value on one line.
pub(super) fn toml_text(value: &Value) -> String {
    let mut text = String::new();
    match value.serialize(toml::ser::ValueSerializer::new(&mut text)) {
        Ok(_) => text,
        // A seed beyond TOML's integers, which `Config::check` refuses.
        Err(_) => format!("{value:?}"),
    }
}

/// FNV-1a: short, stable, and enough to tell configurations apart.
fn fnv1a_64(bytes: &[u8]) -> u64 {
    const OFFSET_BASIS: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    bytes.iter().fold(OFFSET_BASIS, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(PRIME))
}

#[cfg(test)]
mod tests {
    use super::fnv1a_64;

    #[test]
    fn fnv_agrees_with_the_published_vectors() {
        assert_eq!(fnv1a_64(b""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a_64(b"a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(fnv1a_64(b"foobar"), 0x8594_4171_f739_67e8);
    }
}
