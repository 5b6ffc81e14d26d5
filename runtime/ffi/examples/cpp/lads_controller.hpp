// A controller in the shape of ros2_control's controller_interface::ControllerInterface, without ROS: on_configure allocates and
// checks everything, on_activate arms, update allocates nothing, takes no lock and makes no system call.
#ifndef LADS_CONTROLLER_HPP
#define LADS_CONTROLLER_HPP

#include <lads.hpp>

#include <cmath>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

namespace example {

enum class CallbackReturn { SUCCESS, ERROR };
enum class return_type { OK, ERROR };

// One number that hardware shares with a controller, as hardware_interface::LoanedStateInterface and LoanedCommandInterface do.
struct Interface {
    std::string name;
    double value = 0.0;
};

class LadsController {
public:
    struct Parameters {
        std::string image;
        std::string instruction;
        // How long the last command may still be trusted, in seconds.
        float decay_s = 0.2F;
        // Command units per second; none if not above zero.
        float max_rate = 0.0F;
    };

    // Reads the image, sets the controller up, and binds states and commands to the contract by name.
    CallbackReturn on_configure(const Parameters &parameters, std::vector<Interface> &states, std::vector<Interface> &commands) {
        std::ifstream file(parameters.image, std::ios::binary);
        const std::vector<char> bytes{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
        image_.assign((bytes.size() + sizeof(Line) - 1) / sizeof(Line), Line{});
        std::copy(bytes.begin(), bytes.end(), reinterpret_cast<char *>(image_.data()));
        if (auto status = policy_.open({reinterpret_cast<const std::uint8_t *>(image_.data()), bytes.size()}); !status) {
            return failed(parameters.image, status);
        }
        const lads_contract &contract = policy_.contract();
        observation_.assign(contract.observation_len, 0.0F);
        action_.assign(contract.action_len, 0.0F);
        states_.assign(contract.observation_len, nullptr);
        commands_.assign(contract.action_len, nullptr);
        auto element = lads::made<lads_element>();
        for (std::size_t i = 0; i < states_.size(); ++i) {
            if (!policy_.observation(i, element) || (states_[i] = find(states, lads::view(element.name))) == nullptr) {
                return missing("state", lads::view(element.name));
            }
        }
        for (std::size_t i = 0; i < commands_.size(); ++i) {
            if (!policy_.action(i, element) || (commands_[i] = find(commands, lads::view(element.name))) == nullptr) {
                return missing("command", lads::view(element.name));
            }
        }
        const std::vector<float> rates(contract.action_len, parameters.max_rate);
        auto options = lads::made<lads_options>();
        options.fallback = LADS_FALLBACK_DECAY;
        options.decay_s = parameters.decay_s;
        options.late_after = 2;
        options.stop_after = 50;
        options.max_jump = static_cast<std::uint64_t>(1e10 * contract.control_period_s); // ten periods in ns
        options.max_rate = parameters.max_rate > 0.0F ? rates.data() : nullptr;
        if (auto status = controller_.allocate(policy_, options, &report_); !status) {
            return failed("controller", status);
        }
        instruction_ = parameters.instruction;
        return CallbackReturn::SUCCESS;
    }

    // Replays the policy's recorded episode on this machine; only then may it move anything.
    CallbackReturn on_activate() {
        if (auto status = controller_.self_test(); !status) {
            return failed("self-test", status);
        }
        // Some policies take none.
        if (policy_.contract().instruction != LADS_NONE) {
            if (auto status = controller_.set_instruction(instruction_); !status) {
                return failed(instruction_, status);
            }
        }
        // The first update is to take no longer than the others.
        if (auto status = controller_.warm(); !status) {
            return failed("warming up", status);
        }
        return CallbackReturn::SUCCESS;
    }

    // One control period. The commands may be executed, whatever it returns.
    return_type update(std::uint64_t time_ns, std::uint32_t missed) noexcept {
        for (std::size_t i = 0; i < states_.size(); ++i) {
            observation_[i] = static_cast<float>(states_[i]->value);
        }
        const lads::Status status = controller_.step(observation_, action_, lads::tick(time_ns, missed), &report_);
        for (std::size_t i = 0; i < commands_.size(); ++i) {
            commands_[i]->value = static_cast<double>(action_[i]);
        }
        return status ? return_type::OK : return_type::ERROR;
    }

    const lads_report &report() const noexcept { return report_; }
    const lads::Policy &policy() const noexcept { return policy_; }
    lads_counters_t counters() noexcept {
        auto counters = lads::made<lads_counters_t>();
        (void)controller_.counters(counters);
        return counters;
    }

private:
    // The image starts on a cache line.
    struct alignas(LADS_WORKSPACE_ALIGN) Line {
        unsigned char bytes[LADS_WORKSPACE_ALIGN];
    };

    static Interface *find(std::vector<Interface> &interfaces, std::string_view name) {
        for (Interface &candidate : interfaces) {
            if (candidate.name == name) {
                return &candidate;
            }
        }
        return nullptr;
    }
    static CallbackReturn failed(const std::string &what, lads::Status status) {
        std::fprintf(stderr, "lads_controller: %s: %s\n", what.c_str(), status.text());
        return CallbackReturn::ERROR;
    }
    static CallbackReturn missing(const char *kind, std::string_view name) {
        std::fprintf(stderr, "lads_controller: the hardware has no %s interface %.*s\n", kind, static_cast<int>(name.size()),
                     name.data());
        return CallbackReturn::ERROR;
    }

    std::vector<Line> image_;
    lads::Policy policy_;
    lads::Controller controller_;
    std::string instruction_;
    std::vector<float> observation_, action_;
    std::vector<Interface *> states_, commands_;
    lads_report report_ = lads::made<lads_report>();
};

} // namespace example

#endif // LADS_CONTROLLER_HPP
