//! From sources to one tree: defaults < file < environment < `--set`, each value tagged with its origin.
//!
//! Tables merge key by key and lists replace, as figment does it. Two things are prepared for it: a one-of table
//! removes those of lower layers, and a value in the place of a table is refused before it can hide the table.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use figment::value::{Dict, Map, Value};
use figment::{Figment, Metadata, Profile, Provider};
use serde::Deserialize;

use super::effective::{to_value, toml_text};
use super::error::{ConfigError, Problem};
use super::explain::explain;
use super::keys::KeyPath;
use super::lines::{self, Lines};
use super::schema::Config;

/// Start of the names of environment variables.
pub(super) const PREFIX: &str = "HEMOSTREAM_";

/// Variables with our prefix that are not settings: the filter of the log.
const OTHER_VARIABLES: &[&str] = &["HEMOSTREAM_LOG", "HEMOSTREAM_LOG_FORMAT"];

/// Ranks of the layers over the defaults; every `--set` has one of its own above them.
const PRESET_RANK: usize = 1;
const FILE_RANK: usize = 2;
const ENVIRONMENT_RANK: usize = 3;

/// Largest file that is read \[bytes\].
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Tables of which exactly one key may be set, and those keys.
const ONE_OF: &[(&[&str], &[&str])] = &[
    (&["patient", "systole"], &["seconds", "fraction", "bazett"]),
    (&["window", "weights"], &["uniform", "normal", "exponential"]),
    (&["window", "biases"], &["uniform", "normal", "exponential"]),
];

/// Also accepted beside the pressures it belongs to, and moved to its place when read.
const INITIAL_SD_ALIAS: &[&str] = &["patient", "initial", "initial_sd"];
const INITIAL_SD: &[&str] = &["patient", "initial_sd"];

/// What one source says.
struct Layer {
    /// Name of the source, as shown to people.
    origin: String,
    /// Layers of the same rank are one source that happens to come in pieces.
    rank: usize,
    values: Dict,
}

impl Provider for Layer {
    fn metadata(&self) -> Metadata {
        Metadata::named(self.origin.clone())
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Ok(Map::from([(Profile::Default, self.values.clone())]))
    }
}

/// The file's name and where its keys stand, if there is a file.
struct Places(Option<(String, Lines)>);

impl Places {
    /// An origin, with the line if it is the file.
    fn of(&self, path: &KeyPath, origin: &str) -> String {
        let line = self.0.as_ref().filter(|(file, _)| file == origin).and_then(|(_, lines)| lines.get(path));
        line.map_or_else(|| origin.to_owned(), |line| format!("{origin}:{line}"))
    }

    fn refuse(&self, path: &KeyPath, origin: &str, message: impl Into<String>) -> ConfigError {
        let origin = Some(self.of(path, origin));
        ConfigError::Settings(vec![Problem { origin, ..Problem::new(path.to_string(), message) }])
    }
}

/// All layers, merged.
pub(super) struct Stack {
    figment: Figment,
    /// The merged tree, every value tagged with its layer.
    tree: Value,
    places: Places,
}

impl Stack {
    /// Reads and merges the sources; a preset (name and text) lies under the file.
    pub(super) fn read(
        preset: Option<(&str, &str)>,
        file: Option<&Path>,
        environment: impl IntoIterator<Item = (String, String)>,
        sets: &[String],
    ) -> Result<Self, ConfigError> {
        let defaults = to_value(&Config::default()).into_dict().unwrap_or_default();
        let mut layers = vec![Layer { origin: "default".to_owned(), rank: 0, values: defaults }];
        let mut places = Places(None);
        if let Some((name, text)) = preset {
            let (layer, lines) = text_layer(name.to_owned(), text)?;
            places = Places(Some((layer.origin.clone(), lines)));
            layers.push(layer);
        }
        if let Some(path) = file {
            let (layer, lines) = file_layer(path)?;
            places = Places(Some((layer.origin.clone(), lines)));
            layers.push(layer);
        }
        layers.extend(environment_layers(environment));
        for (position, argument) in sets.iter().enumerate() {
            layers.push(set_layer(argument, ENVIRONMENT_RANK + 1 + position)?);
        }

        let shapes = Value::from(layers[0].values.clone());
        for layer in &mut layers[1..] {
            prepare(layer, &shapes).map_err(|(path, message)| places.refuse(&path, &layer.origin, message))?;
        }
        drop_replaced(&mut layers);
        let figment = layers.into_iter().fold(Figment::new(), Figment::merge);
        // An empty path finds the whole tree; only providers can fail, and ours do not.
        let tree = figment.find_value("").unwrap_or_else(|_| Value::from(Dict::new()));
        Ok(Self { figment, tree, places })
    }

    /// Types and names checked, ranges not.
    pub(super) fn extract(&self) -> Result<Config, ConfigError> {
        for (table, known) in ONE_OF {
            let path = KeyPath(table.iter().map(|&segment| segment.to_owned()).collect());
            let entries = find(&self.tree, table).and_then(Value::as_dict);
            if let Some(entries) = entries.filter(|entries| entries.len() != 1) {
                let found = entries.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
                let found = if found.is_empty() { "none".to_owned() } else { found };
                let message = format!("found {found}, expected exactly one of {}", known.join(", "));
                return Err(self.places.refuse(&path, &self.origin(&path), message));
            }
        }
        self.figment.extract().map_err(|error| {
            let path = KeyPath(error.path.clone());
            let origin = error.metadata.as_ref().map_or_else(|| self.origin(&path), |m| m.name.to_string());
            self.places.refuse(&path, &origin, explain(&path, &origin, error.kind))
        })
    }

    /// Where the value with this key, or the innermost table around it, was set.
    pub(super) fn origin(&self, path: &KeyPath) -> String {
        let mut value = &self.tree;
        for segment in &path.0 {
            let inner = match value {
                Value::Dict(_, entries) => entries.get(segment),
                Value::Array(_, entries) => segment.parse().ok().and_then(|position: usize| entries.get(position)),
                _ => None,
            };
            match inner {
                Some(inner) => value = inner,
                None => break,
            }
        }
        self.figment.get_metadata(value.tag()).map_or_else(|| "default".to_owned(), |m| m.name.to_string())
    }

    /// Where a key was set, with the line if that is the file.
    pub(super) fn place(&self, path: &KeyPath) -> String {
        self.places.of(path, &self.origin(path))
    }
}

fn file_layer(path: &Path) -> Result<(Layer, Lines), ConfigError> {
    let file = path.display().to_string();
    let unreadable = |reason: String| ConfigError::Unreadable { file: file.clone(), reason };
    let mut text = String::new();
    let read = File::open(path).and_then(|opened| opened.take(MAX_FILE_BYTES + 1).read_to_string(&mut text));
    let bytes = read.map_err(|error| unreadable(error.to_string()))?;
    if bytes as u64 > MAX_FILE_BYTES {
        return Err(unreadable(format!("found more than {MAX_FILE_BYTES} bytes, expected a configuration")));
    }
    let (layer, lines) = text_layer(file, &text)?;
    Ok((Layer { rank: FILE_RANK, ..layer }, lines))
}

/// A file that has been read, under what it is called.
fn text_layer(file: String, text: &str) -> Result<(Layer, Lines), ConfigError> {
    let table = toml::from_str::<toml::Table>(text).map_err(|error| {
        let (line, column) = lines::position(text, error.span().map_or(0, |span| span.start));
        ConfigError::Syntax { file: file.clone(), line, column, reason: error.message().replace('\n', ", ") }
    })?;
    let values = table.into_iter().map(|(name, value)| (name, from_toml(value))).collect();
    let mut lines = Lines::of(text);
    lines.alias(INITIAL_SD_ALIAS, INITIAL_SD);
    Ok((Layer { origin: file, rank: PRESET_RANK, values }, lines))
}

fn environment_layers(variables: impl IntoIterator<Item = (String, String)>) -> Vec<Layer> {
    let ours = |(name, _): &(String, String)| name.starts_with(PREFIX) && !OTHER_VARIABLES.contains(&name.as_str());
    let mut variables: Vec<_> = variables.into_iter().filter(ours).collect();
    // The order of the environment is arbitrary; errors and results must not be.
    variables.sort();
    let layer = |(name, text): (String, String)| {
        let segments: Vec<String> = name[PREFIX.len()..].split("__").map(str::to_owned).collect();
        // Monitor labels are the only keys with capitals.
        let is_label = |position: usize| position > 0 && segments[0].eq_ignore_ascii_case("labels");
        let spell = |(position, s): (usize, &String)| if is_label(position) { s.clone() } else { s.to_lowercase() };
        let path: Vec<String> = segments.iter().enumerate().map(spell).collect();
        Layer { origin: format!("environment {name}"), rank: ENVIRONMENT_RANK, values: nest(&path, parse_value(&text)) }
    };
    variables.into_iter().map(layer).collect()
}

fn set_layer(argument: &str, rank: usize) -> Result<Layer, ConfigError> {
    let malformed = || ConfigError::Argument { argument: argument.to_owned() };
    let (key, text) = argument.split_once('=').ok_or_else(malformed)?;
    // TOML knows how to read a dotted key with quotes.
    let mut table: toml::Table = toml::from_str(&format!("{} = 0", key.trim())).map_err(|_| malformed())?;
    let mut path = Vec::new();
    while let Some((segment, inner)) = table.into_iter().next() {
        path.push(segment);
        table = if let toml::Value::Table(inner) = inner { inner } else { toml::Table::new() };
    }
    Ok(Layer { origin: "--set".to_owned(), rank, values: nest(&path, parse_value(text)) })
}

/// The tree that holds only `value`.
fn nest(path: &[String], value: Value) -> Dict {
    match path {
        [] => Dict::new(),
        [name] => Dict::from([(name.clone(), value)]),
        [name, inner @ ..] => Dict::from([(name.clone(), nest(inner, value).into())]),
    }
}

/// A TOML value, or else the text itself, so that words need no quotes on a command line.
fn parse_value(text: &str) -> Value {
    toml::Value::deserialize(toml::de::ValueDeserializer::new(text.trim()))
        .map_or_else(|_| Value::from(text), from_toml)
}

fn from_toml(value: toml::Value) -> Value {
    match value {
        toml::Value::String(text) => text.into(),
        toml::Value::Integer(number) => number.into(),
        toml::Value::Float(number) => number.into(),
        toml::Value::Boolean(truth) => truth.into(),
        // No setting is a date, but a name may look like one.
        toml::Value::Datetime(date) => date.to_string().into(),
        toml::Value::Array(entries) => entries.into_iter().map(from_toml).collect::<Vec<_>>().into(),
        toml::Value::Table(entries) => {
            entries.into_iter().map(|(name, value)| (name, from_toml(value))).collect::<Dict>().into()
        }
    }
}

/// Moves aliases to their place and checks that there is a table wherever the schema has one.
fn prepare(layer: &mut Layer, shapes: &Value) -> Result<(), (KeyPath, String)> {
    find_misplaced(&KeyPath::default(), &Value::from(layer.values.clone()), shapes).map_or(Ok(()), Err)?;
    let Some(initial_sd) = take(&mut layer.values, INITIAL_SD_ALIAS) else { return Ok(()) };
    let Some(patient) = layer.values.get_mut("patient").and_then(as_dict_mut) else { return Ok(()) };
    // An empty table would only claim to be the origin of what it does not say.
    if patient.get("initial").and_then(Value::as_dict).is_some_and(Dict::is_empty) {
        patient.remove("initial");
    }
    if patient.insert("initial_sd".to_owned(), initial_sd).is_some() {
        let message = format!("found this and also `{}`, expected one of them", INITIAL_SD_ALIAS.join("."));
        return Err((INITIAL_SD.join(".").into(), message));
    }
    Ok(())
}

/// The first value that stands where the defaults have a table.
fn find_misplaced(path: &KeyPath, value: &Value, shape: &Value) -> Option<(KeyPath, String)> {
    let shape = shape.as_dict()?;
    let Some(entries) = value.as_dict() else {
        let message = format!("found {}, expected a table{}", toml_text(value), one_of_hint(path));
        return Some((path.clone(), message));
    };
    entries.iter().find_map(|(name, value)| find_misplaced(&path.join(name), value, shape.get(name)?))
}

/// Whether a key belongs to a one-of table.
pub(super) fn is_in_one_of(path: &KeyPath) -> bool {
    ONE_OF.iter().any(|(table, _)| path.starts_with(table))
}

fn one_of_hint(path: &KeyPath) -> String {
    let known = ONE_OF.iter().find(|(table, _)| path.0 == *table).map(|(_, known)| known.join(", "));
    known.map(|known| format!(" with one of {known}")).unwrap_or_default()
}

/// Removes every one-of table that a higher layer sets anew.
fn drop_replaced(layers: &mut [Layer]) {
    for (table, _) in ONE_OF.iter() {
        let sets = |layer: &&Layer| find(&Value::from(layer.values.clone()), table).is_some();
        let top = layers.iter().filter(sets).map(|layer| layer.rank).max().unwrap_or(0);
        for layer in layers.iter_mut().filter(|layer| layer.rank < top) {
            take(&mut layer.values, table);
        }
    }
}

fn find<'a>(value: &'a Value, path: &[&str]) -> Option<&'a Value> {
    path.iter().try_fold(value, |value, segment| value.as_dict()?.get(*segment))
}

fn take(values: &mut Dict, path: &[&str]) -> Option<Value> {
    match path {
        [] => None,
        [name] => values.remove(*name),
        [name, inner @ ..] => take(values.get_mut(*name).and_then(as_dict_mut)?, inner),
    }
}

fn as_dict_mut(value: &mut Value) -> Option<&mut Dict> {
    if let Value::Dict(_, entries) = value { Some(entries) } else { None }
}
