//! `tandem flash --info`: what a system holds, as text or JSON. U-2

use crate::boot_args::FlashArgs;
use anyhow::Context as _;
use serde_json::{Value, json};
use tandem_board::Duration;
use tandem_boot::{
    Bank, FlashRegion, ImageTarget, LogEvent, Refusal, ReleaseStage, Selection, Slot, Trial,
};
use tandem_boot_host::{SystemInfo, ask};
use tandem_page::json::JsonOutput;

/// Asks the system, and prints what it holds.
pub(crate) fn run(args: &FlashArgs, json_to: JsonOutput) -> anyhow::Result<()> {
    let system = args.to.context("name the system with --to")?;
    let wire = args.bus.join()?;
    let within = Duration::from_ms(u64::from(args.wait) * 1_000);
    let info = ask(&wire, system, within)?;
    let text = || format!("system {system}\n{}", as_text(&info));
    tandem::print(&json_to.write(&as_json(&info), text)?)
}

/// The name of a place.
const fn place(region: FlashRegion) -> &'static str {
    match region {
        FlashRegion::Target(ImageTarget::Application(Slot::A)) => "application A",
        FlashRegion::Target(ImageTarget::Application(Slot::B)) => "application B",
        FlashRegion::Target(ImageTarget::Configuration(Slot::A)) => "configuration A",
        FlashRegion::Target(ImageTarget::Configuration(Slot::B)) => "configuration B",
        FlashRegion::Target(ImageTarget::Staging) => "staged bootloader",
        FlashRegion::Bank(Bank::Primary) => "bootloader",
        FlashRegion::Bank(Bank::Backup) => "backup bootloader",
        FlashRegion::Environment(_) | FlashRegion::Log(_) => "",
    }
}

/// Returns what a place is used for.
fn role(info: &SystemInfo, region: FlashRegion) -> &'static str {
    let names = |selection: Selection| match region {
        FlashRegion::Target(ImageTarget::Application(slot)) => selection.application == Some(slot),
        FlashRegion::Target(ImageTarget::Configuration(slot)) => {
            selection.configuration == Some(slot)
        }
        _ => false,
    };
    match info.environment.trial {
        Some(Trial { selection, .. }) if names(selection) => "on trial",
        _ if names(info.environment.active) => "active",
        _ => "",
    }
}

/// Returns how far the images on trial are.
fn trial(info: &SystemInfo) -> &'static str {
    match info.environment.trial {
        None => "none",
        Some(Trial { ready: true, .. }) => "ready",
        Some(Trial { executed: true, .. }) => "started",
        Some(_) => "not started",
    }
}

const fn stage(stage: ReleaseStage) -> &'static str {
    match stage {
        ReleaseStage::Trial => "on trial",
        ReleaseStage::Works => "on trial, works",
        ReleaseStage::Ready => "on trial, ready",
        ReleaseStage::Approved => "approved",
    }
}

/// Returns an entry of the log in words.
fn entry((event, value): &(LogEvent, u32)) -> String {
    let refusal = Refusal::from_repr(*value);
    match (event, refusal) {
        (LogEvent::DownloadRefused, Some(refusal)) => format!("{event:?} {value} ({refusal:?})"),
        _ => format!("{event:?} {value}"),
    }
}

fn last_refusal(info: &SystemInfo) -> Option<Refusal> {
    let refused = |(event, _): &&(LogEvent, u32)| *event == LogEvent::DownloadRefused;
    Refusal::from_repr(info.log.iter().find(refused)?.1)
}

fn as_text(info: &SystemInfo) -> String {
    let mut text = String::new();
    let mut line = |name: &str, what: String| {
        text.push_str(&format!("  {name:<22}{}\n", what.trim_end()));
    };
    line(
        "runs",
        match info.running {
            Some((at, version)) => format!("release {version}, {}", stage(at)),
            None => "its bootloader".to_owned(),
        },
    );
    for (region, version) in &info.places {
        let version =
            version.map_or_else(|| "-".to_owned(), |version| format!("release {version}"));
        line(
            place(*region),
            format!("{version:<16}{}", role(info, *region)),
        );
    }
    let environment = &info.environment;
    let [application, configuration, bootloader] = environment.versions;
    line(
        "lowest accepted",
        format!(
            "application {application}, configuration {configuration}, bootloader {bootloader}, \
             key {}",
            environment.lowest_key
        ),
    );
    line("on trial", trial(info).to_owned());
    line("bootloader's update", format!("{:?}", environment.loader));
    line(
        "starts that failed",
        info.starts.saturating_sub(1).to_string(),
    );
    let refusal = last_refusal(info);
    line(
        "last refusal",
        refusal.map_or_else(
            || "none".to_owned(),
            |why| format!("{} ({why:?})", why as u32),
        ),
    );
    for (index, event) in info.log.iter().enumerate() {
        line(
            if index == 0 { "log, newest first" } else { "" },
            entry(event),
        );
    }
    text
}

fn as_json(info: &SystemInfo) -> Value {
    let places = info.places.iter().map(|(region, version)| {
        json!({ "place": place(*region), "release": version, "role": role(info, *region) })
    });
    let log = info
        .log
        .iter()
        .map(|(event, value)| json!({ "event": format!("{event:?}"), "value": value }));
    let environment = &info.environment;
    let [application, configuration, bootloader] = environment.versions;
    json!({
        "running": info.running.map(|(at, version)| json!({
            "release": version,
            "stage": stage(at),
        })),
        "places": places.collect::<Vec<_>>(),
        "lowest": {
            "application": application,
            "configuration": configuration,
            "bootloader": bootloader,
            "key": environment.lowest_key,
        },
        "trial": trial(info),
        "bootloader_update": format!("{:?}", environment.loader),
        "failed_starts": info.starts.saturating_sub(1),
        "last_refusal": last_refusal(info).map(|why| json!({
            "code": why as u32,
            "name": format!("{why:?}"),
        })),
        "log": log.collect::<Vec<_>>(),
    })
}
