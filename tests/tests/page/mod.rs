//! The page in a real browser. Screenshots are kept in `target/page`.
//!
//! `CLEARWAY_PAGE_SECONDS=300 cargo test --release -p clearway-tests --test system page -- --nocapture` looks at the
//! page beside the demo for five minutes, 100 times, and asserts that the map is fresh in 95 of them. Without the
//! variable the test looks 20 times, and asserts that the page shows a fresh map at all and that its console has no
//! errors: a debug build, a simulated sensor and a browser on two shared cores need not keep up.

#[cfg(clearway_browser)]
mod fleet;
#[cfg(clearway_browser)]
mod fresh;
#[cfg(clearway_browser)]
mod replayed;
#[cfg(clearway_browser)]
mod space;
#[cfg(clearway_browser)]
mod webdriver;

macro_rules! in_a_browser {
    ($($name:ident => $test:path),* $(,)?) => { $(
        #[test]
        #[cfg_attr(
            not(clearway_browser),
            ignore = "needs Chromium: apt-get install chromium chromium-driver, then touch tests/build.rs"
        )]
        fn $name() {
            #[cfg(clearway_browser)]
            {
                let _browser = clearway_tests::serial::BROWSER.enter();
                $test();
            }
        }
    )* };
}

in_a_browser! {
    the_page_beside_the_demo_shows_a_fresh_map => fresh::the_page_shows_a_fresh_map,
    a_drive_is_shown_in_3d_with_its_points => space::a_drive_is_shown_in_3d,
    a_cell_on_the_page_has_the_values_that_a_client_reads => replayed::cells_are_those_of_the_client,
    a_viewed_drive_opens_at_its_first_map_and_shows_any_layer_of_it => replayed::a_viewed_drive_opens_at_its_first_map,
    a_viewed_drive_is_recorded_and_not_stale_and_steps => replayed::a_viewed_drive_steps,
    a_plan_is_drawn_over_the_map => replayed::a_plan_is_drawn,
    the_time_bar_steps_and_seeks_a_replay => replayed::the_time_bar_controls_a_replay,
    a_map_that_no_longer_comes_is_stale_with_its_true_age => fleet::a_stopped_vehicle_is_stale,
    a_tab_opened_after_the_fact_shows_what_was => fleet::a_tab_opened_late_shows_what_was,
    vehicles_of_other_servers_are_on_the_page => fleet::other_servers_are_shown,
    the_recorder_is_controlled_from_the_page => fleet::the_recorder_is_controlled,
    the_page_comes_back_after_the_server_does => fleet::the_page_reconnects,
    fifty_vehicles_are_shown_sorted_and_found => fleet::fifty_vehicles_are_shown,
}
