//! Each failure mode of the redundancy has a place in the product that produces it.

/// Where the modes are named.
const MODES: &str = "redundancy/src/state.rs";
/// Where they are produced.
const PRODUCERS: [&str; 2] = ["redundancy/src/", "cores/src/"];
/// Not found by a system in itself.
const NO_FAULTS: [&str; 2] = ["None", "Unknown"];

/// The modes that nothing produces. `files`: all sources, with their texts.
pub(crate) fn findings(files: &[(String, String)]) -> Vec<String> {
    let is_source = |(place, _): &&(String, String)| {
        PRODUCERS.iter().any(|folder| place.starts_with(folder)) && place != MODES
    };
    let sources: Vec<&str> = files
        .iter()
        .filter(is_source)
        .map(|(_, text)| text.as_str())
        .collect();
    let modes = files.iter().find(|(place, _)| place == MODES);
    let without = modes.map(|(_, modes)| without_producer(modes, &sources));
    let finding = |mode| format!("{MODES}: nothing produces the failure mode {mode}");
    without
        .unwrap_or_default()
        .into_iter()
        .map(finding)
        .collect()
}

/// The modes of the list `ALL` that no source names but to compare with it. Tests do not count.
fn without_producer(modes: &str, sources: &[&str]) -> Vec<String> {
    let list = modes.split("pub const ALL").nth(1).unwrap_or_default();
    let list = list.split("];").next().unwrap_or_default();
    let modes = list.split("Self::").skip(1);
    let names = modes.filter_map(|rest| rest.split(|c: char| !c.is_alphanumeric()).next());
    let is_produced = |name: &str| {
        let product = sources
            .iter()
            .filter_map(|text| text.split("#[cfg(test)]\nmod tests {").next());
        product.flat_map(str::lines).any(|line| {
            let compares = line.contains("==") || line.contains("!=");
            let comment = line.trim_start().starts_with("//");
            line.contains(&format!("FailureMode::{name}")) && !compares && !comment
        })
    };
    names
        .filter(|name| !NO_FAULTS.contains(name) && !is_produced(name))
        .map(str::to_owned)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mode_that_is_only_compared_or_tested_has_no_producer() {
        let modes =
            "pub const ALL: [Self; 4] = [\n Self::None,\n Self::A,\n Self::B,\n Self::C,\n];";
        let sources = [
            "self.tell(FailureMode::A);\n// FailureMode::C\n",
            "if mode == FailureMode::B {}\n#[cfg(test)]\nmod tests { x(FailureMode::C) }\n",
        ];
        assert_eq!(without_producer(modes, &sources), ["B", "C"]);
    }
}
